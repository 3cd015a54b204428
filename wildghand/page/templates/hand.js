// A hand of the avatar: from angles of joints to its surface in the world.
"use strict";
const PARENTS = [-1, 0, 1, 2, 0, 4, 5, 0, 7, 8, 0, 10, 11, 0, 13, 14];

function unpack(text, Type) {
  const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  return new Type(bytes.buffer);
}

// Row-major 3x3 matrices.
function product(a, b) {
  const c = new Float64Array(9);
  for (let i = 0; i < 3; i++)
    for (let j = 0; j < 3; j++)
      c[3 * i + j] = a[3 * i] * b[j] + a[3 * i + 1] * b[3 + j] + a[3 * i + 2] * b[6 + j];
  return c;
}
function apply(m, v) {
  return [0, 3, 6].map((i) => m[i] * v[0] + m[i + 1] * v[1] + m[i + 2] * v[2]);
}
function transposed(m) {
  return Float64Array.of(m[0], m[3], m[6], m[1], m[4], m[7], m[2], m[5], m[8]);
}
function rotation(vector) {
  const angle = Math.hypot(...vector);
  if (angle < 1e-12) return Float64Array.of(1, 0, 0, 0, 1, 0, 0, 0, 1);
  const [x, y, z] = vector.map((v) => v / angle);
  const c = Math.cos(angle), s = Math.sin(angle), k = 1 - c;
  return Float64Array.of(
    c + x * x * k, x * y * k - z * s, x * z * k + y * s,
    x * y * k + z * s, c + y * y * k, y * z * k - x * s,
    x * z * k - y * s, y * z * k + x * s, c + z * z * k);
}

// The vector of a rotation, at most pi long.
function logarithm(m) {
  const cosine = (m[0] + m[4] + m[8] - 1) / 2, angle = Math.acos(Math.min(Math.max(cosine, -1), 1));
  const axis = [m[7] - m[5], m[2] - m[6], m[3] - m[1]], length = Math.hypot(...axis);
  if (angle < 1e-6) return axis.map((v) => v / 2);
  if (length > 1e-4) return axis.map((v) => (v / length) * angle);
  // Half a turn: the axis is the longest column of m + 1.
  const columns = [0, 1, 2].map((c) => [m[c], m[3 + c], m[6 + c]].map((v, i) => v + (i === c)));
  const best = columns.reduce((x, y) => (Math.hypot(...y) > Math.hypot(...x) ? y : x));
  return best.map((v) => (v / Math.hypot(...best)) * angle);
}
// (N, C) numbers in 16 bits each.
function whole({ low, step, whole }) {
  return Float32Array.from(unpack(whole, Uint16Array), (v, i) => low[i % low.length] + step[i % low.length] * v);
}
// A function that applies a linear layer: (inputs, outputs) weights and a bias.
function linear(data) {
  const weights = unpack(data.weights, Float32Array), bias = unpack(data.bias, Float32Array);
  const width = bias.length, inputs = weights.length / width;
  return (values, sums = new Float64Array(width)) => {
    sums.set(bias);
    for (let i = 0, k = 0; i < inputs; i++)
      for (let o = 0, v = values[i]; o < width; o++, k++) sums[o] += v * weights[k];
    return sums;
  };
}
const silu = (v) => v / (1 + Math.exp(-v));
// wildghand/gaussians/shading.py, without the constant one.
function harmonics(x, y, z) {
  const s = Math.sqrt(3), a = Math.sqrt(15), b = Math.sqrt(17.5) / 2, c = Math.sqrt(10.5) / 2;
  const d = Math.sqrt(105), fifth = 5 * z * z - 1;
  return [
    s * x, s * y, s * z, a * x * y, a * y * z, a * x * z, (a / 2) * (x * x - y * y),
    (Math.sqrt(5) / 2) * (3 * z * z - 1), b * y * (3 * x * x - y * y), d * x * y * z, c * y * fifth,
    (Math.sqrt(7) / 2) * z * (5 * z * z - 3), c * x * fifth, (d / 2) * z * (x * x - y * y),
    b * x * (x * x - 3 * y * y),
  ];
}
// How the network corrects a pose (wildghand/network/heads.py), from the mean of what the geometry
// branch says at some Gaussians.
class Refinement {
  constructor(data, corners, mix) {
    const { chosen, shares, bounds } = data, places = unpack(data.places, Float32Array);
    const layers = ["normal", "mix", "first", "last"].map((name) => [name, linear(data[name])]);
    Object.assign(this, Object.fromEntries(layers), { bounds, light: data.light });
    this.parts = chosen.map((n, m) => {
      const share = [mix[2 * n] / 65535, mix[2 * n + 1] / 65535], width = places.length / chosen.length;
      return {
        share: shares[m], corners: corners.subarray(3 * n, 3 * n + 3),
        mix: [...share, 1 - share[0] - share[1]], place: places.subarray(m * width, (m + 1) * width),
      };
    });
  }
  // 51 steps of pose and translation, from the surface of the hand and its encoded pose.
  at(surface, posture) {
    const { light } = this, width = this.parts[0].place.length, mean = new Float64Array(light + width);
    const hidden = new Float64Array(width), mixed = new Float64Array(width), normal = new Float64Array(3);
    for (const { share, corners, mix, place } of this.parts) {
      for (let i = 0; i < 3; i++)
        normal[i] = mix[0] * surface[8 * corners[0] + 4 + i] + mix[1] * surface[8 * corners[1] + 4 + i]
          + mix[2] * surface[8 * corners[2] + 4 + i];
      const length = Math.sqrt(normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2);
      const basis = harmonics(normal[0] / length, normal[1] / length, normal[2] / length);
      this.normal(basis, hidden);
      for (let i = 0; i < width; i++) hidden[i] = silu(hidden[i] + place[i] + posture[i]);
      this.mix(hidden, mixed);
      for (let i = 0; i < light; i++) mean[i] += share * basis[i];
      for (let i = 0; i < width; i++) mean[light + i] += share * silu(mixed[i]);
    }
    const { bounds } = this;
    return this.last(this.first(mean).map(silu)).map((v, i) => bounds[i < 48 ? 0 : 1] * Math.tanh(v));
  }
}

// What a network that is too large for the page says: a mean and K components, 15 numbers a Gaussian.
class Table {
  constructor(data) {
    Object.assign(this, { steps: data.steps, bounds: data.bounds, mean: unpack(data.mean, Float32Array) });
    this.basis = unpack(data.basis, Int8Array);
    this.regression = linear(data.regression);
  }
  at(turns) {
    const values = this.mean.slice(), found = this.regression(turns.flatMap((m) => [...m]));
    found.forEach((value, k) => {
      const c = Math.min(Math.max(value, this.bounds[0][k]), this.bounds[1][k]), b = k * values.length;
      const scaled = this.steps[k].map((step) => step * c);
      for (let i = 0; i < values.length; i++) values[i] += scaled[i % 15] * this.basis[b + i];
    });
    return values;
  }
}

class Hand {
  constructor(data) {
    Object.assign(this, { side: data.side, count: data.count, skin: data.skin, joints: data.joints });
    Object.assign(this, { lower: data.lower, upper: data.upper, border: data.border, data });
    // Columns of the axes' matrices: flexion, abduction, twist.
    this.axes = data.axes.map((m) => [0, 1, 2].map((c) => m.map((row) => row[c])));
    this.rest = unpack(data.rest, Float32Array);
    this.bones = unpack(data.bones, Uint8Array);
    this.weights = unpack(data.weights, Float32Array);
    this.faces = unpack(data.faces, Uint32Array);
    this.steps = data.steps && linear(data.steps);
    this.corners = unpack(data.corners, Uint16Array);
    this.mix = unpack(data.mix, Uint16Array);
    this.refinement = data.refined && new Refinement(data.refined, this.corners, this.mix);
    this.table = data.table && new Table(data.table);
    this.motion = unpack(data.motion, Float32Array);
    if (data.correctives) {
      const { basis, map } = data.correctives;
      this.correctives = { basis: unpack(basis, Int8Array), map: unpack(map, Float32Array) };
    }
    // The open wrist's middle and border, once more, carry the discs that close it.
    this.vertices = this.rest.length / 3 + (this.border.length && this.border.length + 1);
    this.frame = 0;
    this.setPose(data.start, data.transl);
  }
  // Axis-angle vectors (16, 3) rad and a translation in m, as everywhere in the project.
  setPose(pose, transl) {
    this.vectors = pose.map((v) => [...v]);
    this.turns = pose.map(rotation);
    this.transl = [...transl];
  }
  setFrame(frame) {
    this.frame = frame;
    const row = this.motion.subarray(51 * frame, 51 * frame + 51);
    const pose = Array.from({ length: 16 }, (_, j) => [...row.subarray(3 * j, 3 * j + 3)]);
    this.setPose(pose, row.subarray(48));
  }
  // Degrees of flexion, abduction and twist of a finger's joint, 1 to 15.
  setAngles(joint, degrees) {
    const [a, b, c] = degrees.map((d, i) =>
      rotation(this.axes[joint - 1][i].map((v) => (v * d * Math.PI) / 180)));
    this.turns[joint] = product(product(a, b), c);
    this.vectors[joint] = logarithm(this.turns[joint]);
  }
  angles(joint) {
    const columns = transposed(Float64Array.from(this.axes[joint - 1].flat()));
    const m = product(product(transposed(columns), this.turns[joint]), columns);
    return [
      Math.atan2(-m[5], m[8]), Math.atan2(m[2], Math.hypot(m[5], m[8])), Math.atan2(-m[1], m[0]),
    ].map((a) => (a * 180) / Math.PI);
  }
  setWrist(degrees) {
    this.vectors[0] = degrees.map((d) => (d * Math.PI) / 180);
    this.turns[0] = rotation(this.vectors[0]);
  }
  // The pose as the network sees it, with the whole hand turned about a place; and its translation.
  turned(turn, centre) {
    if (!turn) return { vectors: this.vectors, turns: this.turns, transl: this.transl };
    const first = product(turn, this.turns[0]), [wrist] = this.joints;
    const moved = apply(turn, wrist.map((v, i) => v + this.transl[i] - centre[i]));
    return {
      vectors: [logarithm(first), ...this.vectors.slice(1)],
      turns: [first, ...this.turns.slice(1)],
      transl: moved.map((v, i) => v + centre[i] - wrist[i]),
    };
  }
  // A pose as the network corrects it. surface: 8 floats a vertex, overwritten; posture: the pose as
  // the network's first layer sees it.
  refined(pose, surface, posture) {
    let step = null;
    if (this.refinement) {
      this.write(surface, 0, pose);
      step = this.refinement.at(surface, posture);
    } else if (this.steps) step = this.steps(pose.turns.flatMap((m) => [...m]));
    if (!step) return pose;
    const vectors = pose.vectors.map((v, j) => v.map((x, i) => x + step[3 * j + i]));
    return { vectors, turns: vectors.map(rotation), transl: pose.transl.map((v, i) => v + step[48 + i]) };
  }
  // Places of the joints and their motions, rest place -> turn * place + shift.
  chain({ turns: local, transl }) {
    const turns = [], places = [], shifts = [];
    for (let j = 0; j < 16; j++) {
      const p = PARENTS[j], rest = this.joints[j];
      if (p < 0) { turns.push(local[0]); places.push(rest); } else {
        const step = apply(turns[p], rest.map((v, i) => v - this.joints[p][i]));
        places.push(places[p].map((v, i) => v + step[i]));
        turns.push(product(turns[p], local[j]));
      }
      const moved = apply(turns[j], rest);
      shifts.push(places[j].map((v, i) => v + transl[i] - moved[i]));
    }
    return { turns, shifts, places: places.map((p) => p.map((v, i) => v + transl[i])) };
  }
  // Rest places of the vertices, with what the hand model's correctives add.
  shaped(local) {
    if (!this.correctives) return this.rest;
    const { basis, map } = this.correctives, rest = this.rest.slice(), count = map.length / 135;
    for (let k = 0; k < count; k++) {
      let sum = 0;
      for (let f = 0; f < 135; f++)
        sum += map[135 * k + f] * (local[1 + ((f / 9) | 0)][f % 9] - (f % 9 % 4 ? 0 : 1));
      for (let i = 0, b = k * rest.length; i < rest.length; i++, b++) rest[i] += sum * basis[b];
    }
    return rest;
  }
  // Write 8 floats a vertex of the surface: its place, 1 unused, its unit normal, 1 unused.
  write(out, first, pose) {
    const { turns, shifts } = this.chain(pose), rest = this.shaped(pose.turns), count = rest.length / 3;
    const start = 8 * first;
    for (let n = 0, o = start; n < count; n++, o += 8) {
      const x = rest[3 * n], y = rest[3 * n + 1], z = rest[3 * n + 2];
      let a = 0, b = 0, c = 0;
      for (let k = 4 * n; k < 4 * n + 4; k++) {
        const w = this.weights[k];
        if (!w) continue;
        const m = turns[this.bones[k]], s = shifts[this.bones[k]];
        a += w * (m[0] * x + m[1] * y + m[2] * z + s[0]);
        b += w * (m[3] * x + m[4] * y + m[5] * z + s[1]);
        c += w * (m[6] * x + m[7] * y + m[8] * z + s[2]);
      }
      out[o] = a; out[o + 1] = b; out[o + 2] = c;
    }
    out.fill(0, start + 8 * count, start + 8 * this.vertices);
    for (let n = 0, o = start; n < count; n++, o += 8) out[o + 4] = out[o + 5] = out[o + 6] = 0;
    for (let f = 0; f < this.faces.length; f += 3) {
      const [i, j, k] = [0, 1, 2].map((c) => start + 8 * this.faces[f + c]);
      const a = out[j] - out[i], b = out[j + 1] - out[i + 1], c = out[j + 2] - out[i + 2];
      const p = out[k] - out[i], q = out[k + 1] - out[i + 1], r = out[k + 2] - out[i + 2];
      const x = b * r - c * q, y = c * p - a * r, z = a * q - b * p;
      for (const o of [i, j, k]) { out[o + 4] += x; out[o + 5] += y; out[o + 6] += z; }
    }
    for (let n = 0, o = start; n < count; n++, o += 8) {
      const length = Math.sqrt(out[o + 4] ** 2 + out[o + 5] ** 2 + out[o + 6] ** 2);
      if (length > 0) { out[o + 4] /= length; out[o + 5] /= length; out[o + 6] /= length; }
      else out[o + 6] = 1;
    }
    if (this.border.length) this.close(out, start, count);
  }
  // The plane of the open wrist; its normal points into the hand (wildghand/model/wrist.py).
  close(out, start, count) {
    const at = (o) => [out[o], out[o + 1], out[o + 2]], border = this.border.map((v) => at(start + 8 * v));
    const mean = (places) => [0, 1, 2].map((i) => places.reduce((sum, p) => sum + p[i], 0) / places.length);
    const centre = mean(border), spokes = border.map((p) => p.map((v, i) => v - centre[i]));
    const normal = [0, 0, 0];
    spokes.forEach(([a, b, c], l) => {
      const [p, q, r] = spokes[(l + 1) % spokes.length];
      normal[0] += b * r - c * q; normal[1] += c * p - a * r; normal[2] += a * q - b * p;
    });
    const middle = mean(Array.from({ length: count }, (_, n) => at(start + 8 * n)));
    const inwards = normal.reduce((sum, v, i) => sum + v * (middle[i] - centre[i]), 0);
    const scale = (inwards < 0 ? -1 : 1) / Math.hypot(...normal);
    [centre, ...border].forEach((place, l) => {
      out.set([...place, 0, ...normal.map((v) => v * scale)], start + 8 * (count + l));
    });
  }
}
