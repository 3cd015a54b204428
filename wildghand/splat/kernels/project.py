"""Gaussians on the image plane and the gradients back, eight at a time in float64.

float64 because a needle's projected covariance is nearly singular, and because a pixel
coordinate in float32 is off by up to 3e-5 px, which an image error of 1e-5 does not allow.

The arrays of a call hold one Gaussian after another, (x, y, z), (x, y, z)...; the projection
works on vectors (x, x, ...), (y, y, ...). Shuffles in registers do the exchange.
"""

# Numba infers the types.
# mypy: allow-untyped-defs

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir
from numba import types

from wildghand.splat import conventions as rules
from wildghand.splat.kernels.jit import inline, jobs, kernel
from wildghand.splat.kernels.tiles import ROW, TILE_HEIGHT
from wildghand.splat.kernels.triples import by, cross, dot, plus, scaled, times
from wildghand.splat.kernels.vectors import (
    LoweredCall,
    Vector,
    ceil,
    floor,
    keep,
    lowered,
    make_constant,
    make_fill,
    select,
    shuffle,
    split_exponent,
    square_root,
)

#: Gaussians that are projected together.
GROUP = 8
#: One float64 for each of them.
EXACT = Vector(types.float64, GROUP)

_SINGLE, _WHOLE = (ir.VectorType(kind, GROUP) for kind in (ir.FloatType(), ir.IntType(32)))
_LARGEST = 3.4028234663852886e38

fill_exact = make_fill(EXACT)
#: 0, 1, ... 7.
lane_index = make_constant(EXACT, range(GROUP))


def make_load_columns(columns: int) -> Any:
    """An intrinsic `load(array, flat_index)` for 8 rows of `columns` float32.

    It gives a tuple with one float64 vector for each column.
    """

    @lowered(lambda array, index: types.UniTuple(EXACT, columns))
    def load_columns(code: LoweredCall, array: Any, index: Any) -> ir.Value:
        whole = code.load(array, index, ir.VectorType(ir.FloatType(), GROUP * columns))
        parts = []
        for column in range(columns):
            part = shuffle(code.builder, whole, whole, range(column, GROUP * columns, columns))
            parts.append(code.builder.fpext(part, EXACT.llvm))
        return code.pack(parts)

    return load_columns


load1, load2, load3, load4 = (make_load_columns(columns) for columns in range(1, 5))


def _as_rows(builder: ir.IRBuilder, parts: Sequence[ir.Value]) -> ir.Value:
    """One vector with the columns row by row."""
    columns, joined = len(parts), list(parts)
    while len(joined) > 1:
        joined += joined[-1:] * (len(joined) % 2)
        both = range(2 * joined[0].type.count)
        pairs = zip(joined[::2], joined[1::2], strict=True)
        joined = [shuffle(builder, first, second, both) for first, second in pairs]
    lanes = [column * GROUP + row for row in range(GROUP) for column in range(columns)]
    return shuffle(builder, joined[0], joined[0], lanes)


@lowered(lambda array, index, values: types.void)
def add_columns(code: LoweredCall, array: Any, index: Any, values: Any) -> None:
    """Adds a tuple of float64 vectors to 8 rows of a float32 array; saturates, never inf."""
    builder, rows = code.builder, _as_rows(code.builder, code.unpack(values))
    single = ir.VectorType(ir.FloatType(), rows.type.count)
    value = builder.fadd(builder.fpext(code.load(array, index, single), rows.type), rows)
    for sign, bound in (("<", _LARGEST), (">", -_LARGEST)):
        limit = ir.Constant(value.type, [bound] * value.type.count)
        value = builder.select(builder.fcmp_ordered(sign, limit, value), limit, value)
    code.store(array, index, builder.fptrunc(value, single))


@lowered(lambda array, index, values: types.void)
def store_columns(code: LoweredCall, array: Any, index: Any, values: Any) -> None:
    """Writes a tuple of float64 vectors to 8 rows of an array of float32 or int32."""
    if code.sig.args[0].dtype == types.float32:
        parts = [code.builder.fptrunc(part, _SINGLE) for part in code.unpack(values)]
    else:
        parts = [code.builder.fptosi(part, _WHOLE) for part in code.unpack(values)]
    code.store(array, index, _as_rows(code.builder, parts))


@lowered(
    lambda array, index, values: (
        types.void if isinstance(values, types.UniTuple) and values.count == 2 * GROUP else None
    )
)
def store_rows(code: LoweredCall, array: Any, index: Any, values: Any) -> None:
    """`store_columns` of 16 columns, of which a single shuffle would be slow."""
    builder = code.builder
    parts = [builder.fptrunc(part, _SINGLE) for part in code.unpack(values)]
    # Vector k holds values k and k + 8 of all rows; three rounds of exchanging the blocks
    # off the diagonal transpose both halves.
    wide = 2 * GROUP
    rows = [shuffle(builder, parts[k], parts[k + GROUP], range(wide)) for k in range(GROUP)]
    for step in (4, 2, 1):
        keep = [wide + lane - step if lane & step else lane for lane in range(wide)]
        give = [wide + lane if lane & step else lane + step for lane in range(wide)]
        done = list(rows)
        for k in range(GROUP):
            if not k & step:
                done[k] = shuffle(builder, rows[k], rows[k + step], keep)
                done[k + step] = shuffle(builder, rows[k], rows[k + step], give)
        rows = done
    pointer = code.place(array, index, rows[0].type)
    for k, row in enumerate(rows):
        builder.store(row, builder.gep(pointer, [ir.Constant(ir.IntType(32), k)]), align=4)


@lowered(lambda value: value)
def round32(code: LoweredCall, value: Any) -> ir.Value:
    """float64 lanes rounded to the precision of float32."""
    return code.builder.fpext(code.builder.fptrunc(value, _SINGLE), EXACT.llvm)


@lowered(lambda value: types.float64)
def total(code: LoweredCall, value: Any) -> ir.Value:
    """Sum of the lanes of a float64 vector, in a fixed order."""
    width = GROUP
    while width > 1:
        width //= 2
        low = shuffle(code.builder, value, value, range(width))
        high = shuffle(code.builder, value, value, range(width, 2 * width))
        value = code.builder.fadd(low, high)
    return code.builder.extract_element(value, ir.Constant(ir.IntType(32), 0))


_TWO_OVER_LN2 = 2.0 / math.log(2.0)


@inline
def log2(x):
    """Base-2 logarithm in every lane, to 1e-12; x positive."""
    mantissa, exponent = split_exponent(x)
    t = (mantissa - 1.0) / (mantissa + 1.0)
    s = t * t
    series = s * (1.0 / 15.0) + 1.0 / 13.0
    series = s * series + 1.0 / 11.0
    series = s * series + 1.0 / 9.0
    series = s * series + 1.0 / 7.0
    series = s * series + 1.0 / 5.0
    series = s * series + 1.0 / 3.0
    series = s * series + 1.0
    return exponent + t * series * _TWO_OVER_LN2


@inline
def clamp(x, low, high):
    """x brought into [low, high]."""
    x = select(x < low, low, x)
    return select(x > high, high, x)


@inline
def rotation(quat):
    """Rotation matrix of a unit quaternion, row by row."""
    w, x, y, z = quat
    xx, yy, zz = x * x, y * y, z * z
    xy, xz, yz, wx, wy, wz = x * y, x * z, y * z, w * x, w * y, w * z
    one = fill_exact(1.0)
    return (
        (one - (yy + zz) * 2.0, (xy - wz) * 2.0, (xz + wy) * 2.0),
        ((xy + wz) * 2.0, one - (xx + zz) * 2.0, (yz - wx) * 2.0),
        ((xz - wy) * 2.0, (yz + wx) * 2.0, one - (xx + yy) * 2.0),
    )


#: Numbers of a camera: rotation row by row, translation, fx, fy, cx, cy, and the range of the
#: tangents of view angles within which the perspective's Jacobian is followed, x then y.
CAMERA = 20
ROTATION, TRANSLATION, FOCAL, CENTER, TANGENTS = 0, 9, 12, 14, 16

_MARGIN = rules.FRUSTUM_MARGIN


@kernel
def prepare_cameras(viewmats, Ks, width, height, rows):
    """Writes the numbers of each camera; those of one that is not usable make it see nothing.

    Args:
        viewmats: float64 (I, 4, 4), world to camera.
        Ks: float64 (I, 3, 3), px.
        width, height: of the images, px.
        rows: out, float64 (I, CAMERA).
    """
    for i in range(len(rows)):
        row = rows[i]
        usable = Ks[i, 0, 0] > 0.0 and Ks[i, 1, 1] > 0.0
        for j in range(3):
            for k in range(3):
                row[ROTATION + 3 * j + k] = viewmats[i, j, k]
            row[TRANSLATION + j] = viewmats[i, j, 3]
        for j in range(2):
            row[FOCAL + j] = Ks[i, j, j]
            row[CENTER + j] = Ks[i, j, 2]
        for k in range(TANGENTS):
            usable = usable and math.isfinite(row[k])
        if not usable:
            row[:] = 0.0
            row[TRANSLATION + 2] = -1.0  # all that there is lies behind it
            row[FOCAL] = row[FOCAL + 1] = 1.0
        for j in range(2):
            size = height if j else width
            row[TANGENTS + 2 * j] = -(row[CENTER + j] + _MARGIN * size) / row[FOCAL + j]
            row[TANGENTS + 2 * j + 1] = (size - row[CENTER + j] + _MARGIN * size) / row[FOCAL + j]


@inline
def camera_row(camera, row):
    """A row of the camera's rotation."""
    return (camera[3 * row], camera[3 * row + 1], camera[3 * row + 2])


@inline
def to_camera(camera, mean):
    """Means in camera axes."""
    return (
        dot(mean, camera_row(camera, 0)) + camera[9],
        dot(mean, camera_row(camera, 1)) + camera[10],
        dot(mean, camera_row(camera, 2)) + camera[11],
    )


@inline
def jacobian_row(camera, axis, scale, tangent):
    """One row of J R: the perspective's Jacobian times the camera's rotation."""
    a, b = camera_row(camera, axis), camera_row(camera, 2)
    return (
        scale * (a[0] - tangent * b[0]),
        scale * (a[1] - tangent * b[1]),
        scale * (a[2] - tangent * b[2]),
    )


#: Gaussians in a piece of work; sums over Gaussians are made piece by piece, in order.
PIECE = 512
#: exponent -1/2 d^2 in base 2.
_HALF_LOG2E = 0.5 * math.log2(math.e)
_LOG2_255 = math.log2(255.0)
_SQUARED_REACH = 2.0 * math.log(2.0)
_MAX_REACH = rules.MAX_REACH
_MAX_ALONG = math.sqrt(rules.MAX_PRECISION * _HALF_LOG2E)
_MIN_ALPHA = rules.MIN_ALPHA
_MAX_COLOR = np.float32(rules.MAX_COLOR)
_MAX_OPACITY = 3.5e38
_MAX_RADIUS = 2.0**30


class Ellipsoids(NamedTuple):
    """Place, rotation and size of S x N Gaussians, or their gradients; N at least `GROUP`.

    Image i of I reads entry i // (I // S), for each of the three its own S.
    """

    means: np.ndarray  # (S, N, 3) float32
    quats: np.ndarray  # (S, N, 4) float32
    scales: np.ndarray  # (S, N, 3) float32


class View(NamedTuple):
    """The numbers of `scene.Options` that the projection reads."""

    width: float  # px
    height: float  # px
    near: float
    far: float
    eps2d: float  # px^2
    antialiased: bool


class Projected(NamedTuple):
    """The Gaussians on the image planes."""

    geom: np.ndarray  # (I, N, 16) float32, see `geometry`
    depths: np.ndarray  # (I, N) float32, 0 where culled
    rows: np.ndarray  # (I, N) int32, rows of tiles that the splat touches
    radii: np.ndarray  # (I, N, 2) int32, half the size of the visible part in pixels
    compensations: np.ndarray  # (I, N) float32, or (I, 0) if not antialiased


class OnPlane(NamedTuple):
    """Eight Gaussians as the perspective, made linear at their centres, flattens them.

    With J the Jacobian of the perspective, R the camera's rotation, and M the Gaussian's rotation
    times its sizes, the covariance on the image plane is J R M (J R M)^T + eps2d = (A B; B C).
    """

    inverse: Any  # 1 / z
    tangent: tuple[Any, Any]  # x / z and y / z
    held: tuple[Any, Any]  # the same within the range where J is followed
    t: tuple[Any, Any]  # rows of J R
    w: tuple[Any, Any]  # rows of J R times the Gaussian's rotation
    u: tuple[Any, Any, Any]  # first row of J R M
    v: tuple[Any, Any, Any]  # second row
    normal: tuple[Any, Any, Any]  # u x v, which keeps its digits for needles
    area: Any  # its squared length: the determinant without eps2d
    A: Any
    B: Any
    C: Any
    det: Any


@inline
def entry_of(shared, image, images):
    """Which entry of a shared array an image reads."""
    return image // (images // max(1, len(shared)))


@inline
def load_group(ellipsoids, image, images, n):
    """Means, quaternions and scales of 8 Gaussians from the n-th on, as an image reads them."""
    means, quats, scales = ellipsoids
    gaussians = means.shape[1]
    return (
        load3(means, (entry_of(means, image, images) * gaussians + n) * 3),
        load4(quats, (entry_of(quats, image, images) * gaussians + n) * 4),
        load3(scales, (entry_of(scales, image, images) * gaussians + n) * 3),
    )


@inline
def unit(quat):
    """A quaternion of length 1, and what it was multiplied by."""
    w, x, y, z = quat
    over = 1.0 / square_root(w * w + x * x + y * y + z * z)
    return (w * over, x * over, y * over, z * over), over


@inline
def flatten(camera, x, y, z, turn, size, eps2d):
    """`OnPlane` of Gaussians at x, y, z in camera axes."""
    inverse = 1.0 / z
    tan_x = x * inverse
    tan_y = y * inverse
    held_x = clamp(tan_x, camera[16], camera[17])
    held_y = clamp(tan_y, camera[18], camera[19])
    t_x = jacobian_row(camera, 0, inverse * camera[12], held_x)
    t_y = jacobian_row(camera, 1, inverse * camera[13], held_y)
    w_x, w_y = times(t_x, turn), times(t_y, turn)
    u, v = scaled(w_x, size), scaled(w_y, size)
    normal = cross(u, v)
    area = dot(normal, normal)
    trace_x, trace_y = dot(u, u), dot(v, v)
    det = area + (trace_x + trace_y) * eps2d + eps2d * eps2d
    return OnPlane(
        inverse, (tan_x, tan_y), (held_x, held_y), (t_x, t_y), (w_x, w_y), u, v, normal, area,
        trace_x + eps2d, dot(u, v), trace_y + eps2d, det,
    )  # fmt: skip


@inline
def project_group(mean, quat, size, alpha, usable, camera, view, projected, to):
    """Projects 8 Gaussians and writes them to the flat index `to` of `projected`."""
    x, y, z = to_camera(camera, mean)
    seen = (z > view.near) & (z < view.far) & (usable > 0.0)
    z = select(seen, z, 1.0)
    quat, over = unit(quat)
    seen = seen & (over < math.inf)
    plane = flatten(camera, x, y, z, rotation(quat), size, view.eps2d)
    if view.antialiased:
        ratio = square_root(plane.area / plane.det)
        alpha = alpha * ratio
        store_columns(projected.compensations, to, (select(ratio > 0.0, ratio, 0.0),))
    seen = seen & (plane.det > 0.0) & (alpha >= _MIN_ALPHA) & (alpha < _MAX_OPACITY)
    log_alpha = log2(select(seen, alpha, 1.0))
    store_visible(seen, z, log_alpha, plane, camera, view, projected, to)


@inline
def tile_row(y, height):
    """The row of tiles that a place on the image plane lies in, or the nearest."""
    return floor(clamp(y - 0.5, 0.0, height - 1.0) * (1.0 / TILE_HEIGHT))


@inline
def store_visible(seen, z, log_alpha, plane, camera, view, projected, to):
    """Culls Gaussians off screen, too large or too thin; writes the others, and zeros if culled."""
    A, B, C = plane.A, plane.B, plane.C
    reach = (log_alpha + _LOG2_255) * _SQUARED_REACH
    reach_x = square_root(reach * A)
    reach_y = square_root(reach * C)
    px = plane.tangent[0] * camera[12] + camera[14]
    py = plane.tangent[1] * camera[13] + camera[15]
    along = square_root(C / plane.det * _HALF_LOG2E)
    across = square_root(_HALF_LOG2E / C)
    seen = seen & (reach_x < _MAX_REACH) & (reach_y < _MAX_REACH) & (along < _MAX_ALONG)
    seen = seen & (px + reach_x >= 0.5) & (px - reach_x <= view.width - 0.5)
    seen = seen & (py + reach_y >= 0.5) & (py - reach_y <= view.height - 0.5)
    first = tile_row(py - reach_y, view.height)
    rows = tile_row(py + reach_y, view.height) - first + 1.0
    shear = 0.0 - B / C
    px_high, py_high, shear_high = round32(px), round32(py), round32(shear)
    zero = fill_exact(0.0)
    row = (
        px_high, py_high, px - px_high, py - py_high, shear_high, shear - shear_high,
        along, across, log_alpha, reach_x, reach_y, reach_x * (B / A), first, rows, zero, zero,
    )  # fmt: skip
    store_rows(projected.geom, to * ROW, keep(seen, row))
    store_columns(projected.depths, to, keep(seen, (z,)))
    store_columns(projected.rows, to, keep(seen, (rows,)))
    radii = (clamp(ceil(reach_x), 0.0, _MAX_RADIUS), clamp(ceil(reach_y), 0.0, _MAX_RADIUS))
    store_columns(projected.radii, 2 * to, keep(seen, radii))


@inline
def mark_usable(colors, entry, first, usable):
    """Writes 1 for each of 8 Gaussians whose colour is within bounds, else 0."""
    for lane in range(GROUP):
        bad = False
        for k in range(colors.shape[2]):
            bad |= not (abs(colors[entry, first + lane, k]) <= _MAX_COLOR)
        usable[lane] = np.float32(0.0) if bad else np.float32(1.0)


@kernel
def project(worker, counters, ends, ellipsoids, opacities, colors, cameras, view, projected):
    """Projects every Gaussian of every image.

    Args:
        worker, counters, ends: see `jit.jobs`; a job is a piece of an image.
        ellipsoids: `Ellipsoids`.
        opacities: float32 (S, N).
        colors: float32 (S, N, D), to see which are finite.
        cameras: float64 (I, CAMERA), see `cameras`.
        view: `View`.
        projected: out, `Projected`; compensations only if antialiased.
    """
    images, gaussians = projected.depths.shape
    pieces = max(1, gaussians // PIECE)
    usable = np.empty(GROUP, np.float32)
    for job in jobs(worker, counters, ends):
        image, piece = job // pieces, job % pieces
        of_opacities = entry_of(opacities, image, images) * gaussians
        stop = (piece + 1) * gaussians // pieces
        for start in range(piece * gaussians // pieces, stop, GROUP):
            n = min(start, stop - GROUP)
            mark_usable(colors, entry_of(colors, image, images), n, usable)
            (may,) = load1(usable, 0)
            (alpha,) = load1(opacities, of_opacities + n)
            mean, quat, size = load_group(ellipsoids, image, images, n)
            project_group(
                mean, quat, size, alpha, may, cameras[image], view, projected,
                image * gaussians + n,
            )  # fmt: skip


class PlaneGradients(NamedTuple):
    """Gradients of the loss by the projected Gaussians."""

    means2d: np.ndarray  # (I, N, 2) float32
    shapes: np.ndarray  # (I, N, 3) float32, see `reduce`
    depths: np.ndarray  # (I, N) float32, or (0, 0) if depth has no gradient
    compensations: np.ndarray  # (I, N) float32, read only if antialiased


@kernel
def project_backward(
    worker, counters, ends, ellipsoids, cameras, depths, view, upstream, gradients, v_cameras
):
    """Gradients of the Gaussians and the cameras.

    Args:
        depths: float32 (I, N); 0 where culled.
        v_cameras: out, float64 (I, pieces, 12); rotation row by row, then translation, one sum
            for each piece of Gaussians. (I, 0, 12) if it is not needed.
    """
    images, gaussians = depths.shape
    pieces = max(1, gaussians // PIECE)
    with_cameras = v_cameras.shape[1] > 0
    zero = fill_exact(0.0)
    nothing = (zero, zero, zero)
    for piece in jobs(worker, counters, ends):
        begin, stop = piece * gaussians // pieces, (piece + 1) * gaussians // pieces
        for i in range(images):
            camera = cameras[i]
            for gradient in gradients:
                clear_first(gradient, i, images, begin, stop)
            of_means = entry_of(gradients.means, i, images) * gaussians
            of_quats = entry_of(gradients.quats, i, images) * gaussians
            of_scales = entry_of(gradients.scales, i, images) * gaussians
            sums = (nothing, nothing, nothing, nothing)
            for start in range(begin, stop, GROUP):
                first = min(start, stop - GROUP)
                (depth,) = load1(depths, i * gaussians + first)
                # The last group of a piece reaches back; those that it repeats count once.
                seen = (depth > 0.0) & (lane_index() >= np.float64(start - first))
                mean, quat, size = load_group(ellipsoids, i, images, first)
                plane, moved, v_quat, v_size, v_t = group_backward(
                    seen, mean, quat, size, camera, view, upstream, i * gaussians + first
                )
                add_columns(gradients.means, (of_means + first) * 3, from_camera(camera, moved))
                add_columns(gradients.quats, (of_quats + first) * 4, v_quat)
                add_columns(gradients.scales, (of_scales + first) * 3, v_size)
                if with_cameras:
                    sums = add_camera(sums, seen, keep(seen, mean), moved, plane, camera, v_t)
            if with_cameras:
                place = v_cameras[i, piece]
                for row in range(4):
                    for k in range(3):
                        place[3 * row + k] = total(sums[row][k])


@inline
def group_backward(seen, mean, quat, size, camera, view, upstream, at):
    """Gradients of 8 Gaussians from those at the flat index `at`; zeros where not seen."""
    x, y, z = to_camera(camera, mean)
    z = select(seen, z, 1.0)
    quat, over = unit(quat)
    turn = rotation(quat)
    plane = flatten(camera, x, y, z, turn, size, view.eps2d)

    v_log_a, v_log_c, v_shear = load3(upstream.shapes, 3 * at)
    v_u, v_v = shape_gradient(plane, view.eps2d, v_log_a, v_log_c, v_shear)
    if view.antialiased:
        (v_ratio,) = load1(upstream.compensations, at)
        more_u, more_v = compensation_gradient(plane, view.eps2d, v_ratio)
        v_u, v_v = plus(v_u, more_u), plus(v_v, more_v)
    v_size = plus(scaled(v_u, plane.w[0]), scaled(v_v, plane.w[1]))
    v_wx, v_wy = scaled(v_u, size), scaled(v_v, size)
    t_x, t_y = plane.t
    v_turn = (
        plus(by(v_wx, t_x[0]), by(v_wy, t_y[0])),
        plus(by(v_wx, t_x[1]), by(v_wy, t_y[1])),
        plus(by(v_wx, t_x[2]), by(v_wy, t_y[2])),
    )
    v_quat = quaternion_gradient(quat, over, v_turn)
    v_tx = (dot(turn[0], v_wx), dot(turn[1], v_wx), dot(turn[2], v_wx))
    v_ty = (dot(turn[0], v_wy), dot(turn[1], v_wy), dot(turn[2], v_wy))

    v_px, v_py = load2(upstream.means2d, 2 * at)
    v_x, v_y, v_z = position_gradient(x, y, plane, camera, v_px, v_py, v_tx, v_ty)
    if upstream.depths.size > 0:
        (v_depth,) = load1(upstream.depths, at)
        v_z = v_z + v_depth
    moved = keep(seen, (v_x, v_y, v_z))
    return plane, moved, keep(seen, v_quat), keep(seen, v_size), (v_tx, v_ty)


@inline
def shape_gradient(plane, eps2d, v_log_a, v_log_c, v_shear):
    """Gradient of the two rows of J R M from that of the Cholesky form of their Gram matrix.

    What is left of u after its part along v, u + shear v, is tiny compared to u for a needle; as a
    vector product with u x v it keeps its digits.
    """
    u, v, normal = plane.u, plane.v, plane.normal
    shear = 0.0 - plane.B / plane.C
    a = plane.C / plane.det
    c = 1.0 / plane.C
    g = a * v_log_a * (0.0 - 2.0)  # twice the gradient of 1 / a
    h = v_shear * square_root(a * c)
    rest = by(plus(cross(v, normal), by(u, fill_exact(eps2d))), c)
    v_u = plus(by(rest, g), by(v, 0.0 - h))
    tilted = plus(rest, by(v, shear))
    v_v = plus(by(rest, shear * g), plus(by(tilted, 0.0 - h), by(v, c * v_log_c * (0.0 - 2.0))))
    return v_u, v_v


@inline
def compensation_gradient(plane, eps2d, v_ratio):
    """Gradient of the two rows from that of sqrt(area / det)."""
    u, v, normal, area, det = plane.u, plane.v, plane.normal, plane.area, plane.det
    ratio = square_root(area / det)
    half = v_ratio * ratio
    of_area = select(area > 0.0, half / area, 0.0) - half / det
    of_trace = half * (0.0 - eps2d) / det
    v_u = plus(by(cross(v, normal), of_area), by(u, of_trace))
    v_v = plus(by(cross(normal, u), of_area), by(v, of_trace))
    return v_u, v_v


@inline
def quaternion_gradient(quat, over, n):
    """Gradient of a quaternion of norm 1 / over, `quat` times it, from that of its matrix."""
    w, x, y, z = quat
    n0, n1, n2 = n
    g_w = (x * (n2[1] - n1[2]) + y * (n0[2] - n2[0]) + z * (n1[0] - n0[1])) * 2.0
    g_x = (y * (n1[0] + n0[1]) + z * (n2[0] + n0[2]) + w * (n2[1] - n1[2])) * 2.0
    g_x = g_x - x * (n1[1] + n2[2]) * 4.0
    g_y = (x * (n1[0] + n0[1]) + z * (n2[1] + n1[2]) + w * (n0[2] - n2[0])) * 2.0
    g_y = g_y - y * (n0[0] + n2[2]) * 4.0
    g_z = (x * (n2[0] + n0[2]) + y * (n2[1] + n1[2]) + w * (n1[0] - n0[1])) * 2.0
    g_z = g_z - z * (n0[0] + n1[1]) * 4.0
    radial = g_w * w + g_x * x + g_y * y + g_z * z
    return (
        (g_w - radial * w) * over,
        (g_x - radial * x) * over,
        (g_y - radial * y) * over,
        (g_z - radial * z) * over,
    )


@inline
def position_gradient(x, y, plane, camera, v_px, v_py, v_tx, v_ty):
    """Gradient of a mean in camera axes from those of its pixel and of the rows of J R."""
    fx, fy = camera[12], camera[13]
    inverse = plane.inverse
    scale_x, scale_y = inverse * fx, inverse * fy
    v_scale_x = dot(v_tx, plane.t[0]) / scale_x
    v_scale_y = dot(v_ty, plane.t[1]) / scale_y
    along_x = dot(v_tx, camera_row(camera, 2))
    along_y = dot(v_ty, camera_row(camera, 2))
    tan_x, tan_y = plane.tangent
    free_x = (tan_x >= camera[16]) & (tan_x <= camera[17])
    free_y = (tan_y >= camera[18]) & (tan_y <= camera[19])
    zero = fill_exact(0.0)
    v_tan_x = v_px * fx - select(free_x, scale_x * along_x, zero)
    v_tan_y = v_py * fy - select(free_y, scale_y * along_y, zero)
    v_inverse = v_scale_x * fx + v_scale_y * fy + v_tan_x * x + v_tan_y * y
    return v_tan_x * inverse, v_tan_y * inverse, zero - v_inverse * inverse * inverse


@inline
def from_camera(camera, moved):
    """Gradient of a mean in the world from that in camera axes."""
    return times(moved, (camera_row(camera, 0), camera_row(camera, 1), camera_row(camera, 2)))


@inline
def add_camera(sums, seen, mean, moved, plane, camera, v_t):
    """Adds the gradients of the camera's rotation, row by row, and of its translation.

    J R depends on R through its own row and, by the tangent, the third.
    """
    v_x, v_y, v_z = moved
    of_x = keep(seen, by(v_t[0], plane.inverse * camera[12]))
    of_y = keep(seen, by(v_t[1], plane.inverse * camera[13]))
    held_x, held_y = keep(seen, plane.held)
    held = plus(by(of_x, held_x), by(of_y, held_y))
    return (
        plus(sums[0], plus(by(mean, v_x), of_x)),
        plus(sums[1], plus(by(mean, v_y), of_y)),
        plus(sums[2], plus(by(mean, v_z), by(held, fill_exact(-1.0)))),
        plus(sums[3], moved),
    )


@inline
def clear_first(gradient, image, images, begin, stop):
    """Zeros for Gaussians `begin` to `stop`, by the first image of those that share them."""
    if image % (images // max(1, len(gradient))) == 0:
        gradient[entry_of(gradient, image, images), begin:stop] = 0.0
