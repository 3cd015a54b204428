// A hand of the avatar: from angles of joints to Gaussians in the world.
"use strict";
// Colour of skin that no frame has shown; no skin has it.
const UNSEEN = [0.55, 0.2, 0.85];
// Colours of a weight from 0 to 1, and of a place without one.
const RAMP = [[0.27, 0.0, 0.33], [0.23, 0.32, 0.55], [0.13, 0.57, 0.55], [0.37, 0.79, 0.38], [0.99, 0.91, 0.14]];
const UNWEIGHED = [0.6, 0.6, 0.6];
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

// N vectors that are linear in the rotations of the joints: mean, and K components.
class LinearPart {
  constructor(data) {
    this.mean = unpack(data.mean, Float32Array);
    this.basis = unpack(data.basis, Int8Array);
    this.regression = unpack(data.regression, Float32Array);
    this.steps = data.steps;
    this.bounds = data.bounds;
    this.values = this.mean.slice();
  }
  update(turns) {
    const rank = this.steps.length, size = this.mean.length;
    this.values.set(this.mean);
    for (let k = 0; k < rank; k++) {
      let sum = this.regression[144 * rank + k];
      for (let f = 0; f < 144; f++) sum += turns[(f / 9) | 0][f % 9] * this.regression[f * rank + k];
      const c = this.steps[k] * Math.min(Math.max(sum, this.bounds[0][k]), this.bounds[1][k]);
      for (let i = 0, b = k * size; i < size; i++, b++) this.values[i] += c * this.basis[b];
    }
  }
}

// What the fit explained as the perturbation of each frame: sum over k of c_fk basis_k, 8 numbers a Gaussian.
class FrameBiases {
  constructor(data, count) {
    this.basis = unpack(data.basis, Int8Array);
    this.steps = data.steps;
    this.coefficients = data.coefficients;
    this.values = new Float32Array(8 * count);
    this.frame = -1;
  }
  update(frame) {
    if (frame === this.frame) return;
    const size = this.values.length;
    this.values.fill(0);
    this.steps.forEach((steps, k) => {
      const c = steps.map((step) => step * this.coefficients[frame][k]);
      for (let i = 0, b = k * size; i < size; i++, b++) this.values[i] += c[i & 7] * this.basis[b];
    });
    this.frame = frame;
  }
}
function ramp(share) {
  const place = Math.min(Math.max(share, 0), 1) * (RAMP.length - 1), low = Math.min(place | 0, RAMP.length - 2);
  return RAMP[low].map((v, i) => v + (place - low) * (RAMP[low + 1][i] - v));
}

class Hand {
  constructor(data) {
    Object.assign(this, { side: data.side, count: data.count, joints: data.joints });
    this.lower = data.lower;
    this.upper = data.upper;
    // Columns of the axes' matrices: flexion, abduction, twist.
    this.axes = data.axes.map((m) => [0, 1, 2].map((c) => m.map((row) => row[c])));
    this.influences = unpack(data.influences, Uint8Array);
    this.weights = unpack(data.weights, Uint16Array);
    this.means = new LinearPart(data.means);
    this.colors = new LinearPart(data.colors);
    this.covariances = unpack(data.covariances, Float32Array);
    this.opacities = unpack(data.opacities, Float32Array);
    this.restNormals = unpack(data.normals, Int8Array);
    this.seen = data.seen && unpack(data.seen, Uint8Array);
    this.biases = data.biases && new FrameBiases(data.biases, data.count);
    this.trusted = data.trusted && unpack(data.trusted, Uint8Array);
    this.motion = unpack(data.motion, Float32Array);
    this.frame = 0;
    this.start = { pose: data.start, transl: data.transl };
    this.normals = new Float32Array(3 * this.count);
    this.setPose(this.start.pose, this.start.transl);
  }
  // Axis-angle vectors (16, 3) rad and a translation in m, as everywhere in the project.
  setPose(pose, transl) {
    this.turns = pose.map(rotation);
    this.transl = [...transl];
    this.vector = [...pose[0]];
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
  }
  angles(joint) {
    const columns = transposed(Float64Array.from(this.axes[joint - 1].flat()));
    const m = product(product(transposed(columns), this.turns[joint]), columns);
    return [
      Math.atan2(-m[5], m[8]), Math.atan2(m[2], Math.hypot(m[5], m[8])), Math.atan2(-m[1], m[0]),
    ].map((a) => (a * 180) / Math.PI);
  }
  setWrist(degrees) {
    this.vector = degrees.map((d) => (d * Math.PI) / 180);
    this.turns[0] = rotation(this.vector);
  }
  // Places of the joints and their motions: rest place -> turn * place + shift.
  chain() {
    const turns = [], places = [], shifts = [];
    for (let j = 0; j < 16; j++) {
      const p = PARENTS[j], rest = this.joints[j];
      if (p < 0) { turns.push(this.turns[0]); places.push(rest); } else {
        const step = apply(turns[p], rest.map((v, i) => v - this.joints[p][i]));
        places.push(places[p].map((v, i) => v + step[i]));
        turns.push(product(turns[p], this.turns[j]));
      }
      const moved = apply(turns[j], rest);
      shifts.push(places[j].map((v, i) => v + this.transl[i] - moved[i]));
    }
    return { turns, shifts, places: places.map((p) => p.map((v, i) => v + this.transl[i])) };
  }
  // Write 16 floats a Gaussian: mean, opacity, covariance (6), 2 unused, colour, 1 unused.
  // shown: `clean`, `biases` of the frame or `weights` of the fit.
  write(out, first, light, marks, shown) {
    const { turns, shifts } = this.chain();
    this.means.update(this.turns);
    this.colors.update(this.turns);
    const add = shown === "biases" && this.biases && this.biases.values;
    if (add) this.biases.update(this.frame);
    const A = new Float64Array(9), B = new Float64Array(9);
    const m = this.means.values, c = this.covariances, rgb = this.colors.values;
    for (let n = 0, o = 16 * first; n < this.count; n++, o += 16) {
      A.fill(0);
      let tx = 0, ty = 0, tz = 0, total = 0;
      for (let k = 4 * n; k < 4 * n + 4; k++) {
        const w = this.weights[k];
        if (!w) continue;
        const turn = turns[this.influences[k]], shift = shifts[this.influences[k]];
        for (let i = 0; i < 9; i++) A[i] += w * turn[i];
        tx += w * shift[0]; ty += w * shift[1]; tz += w * shift[2]; total += w;
      }
      for (let i = 0; i < 9; i++) A[i] /= total;
      const e = 8 * n;
      const x = m[3 * n] + (add ? add[e] : 0), y = m[3 * n + 1] + (add ? add[e + 1] : 0);
      const z = m[3 * n + 2] + (add ? add[e + 2] : 0);
      out[o] = A[0] * x + A[1] * y + A[2] * z + tx / total;
      out[o + 1] = A[3] * x + A[4] * y + A[5] * z + ty / total;
      out[o + 2] = A[6] * x + A[7] * y + A[8] * z + tz / total;
      out[o + 3] = Math.min(Math.max(this.opacities[n] + (add ? add[e + 6] : 0), 0), 1);
      const s = 6 * n, wide = add ? Math.exp(2 * add[e + 7]) : 1;
      const xx = wide * c[s], xy = wide * c[s + 1], xz = wide * c[s + 2];
      const yy = wide * c[s + 3], yz = wide * c[s + 4], zz = wide * c[s + 5];
      for (let i = 0; i < 9; i += 3) {
        B[i] = A[i] * xx + A[i + 1] * xy + A[i + 2] * xz;
        B[i + 1] = A[i] * xy + A[i + 1] * yy + A[i + 2] * yz;
        B[i + 2] = A[i] * xz + A[i + 1] * yz + A[i + 2] * zz;
      }
      out[o + 4] = B[0] * A[0] + B[1] * A[1] + B[2] * A[2];
      out[o + 5] = B[0] * A[3] + B[1] * A[4] + B[2] * A[5];
      out[o + 6] = B[0] * A[6] + B[1] * A[7] + B[2] * A[8];
      out[o + 7] = B[3] * A[3] + B[4] * A[4] + B[5] * A[5];
      out[o + 8] = B[3] * A[6] + B[4] * A[7] + B[5] * A[8];
      out[o + 9] = B[6] * A[6] + B[7] * A[7] + B[8] * A[8];
      let gain = 1;
      if (light) {
        const p = this.restNormals[3 * n], q = this.restNormals[3 * n + 1];
        const r = this.restNormals[3 * n + 2];
        const u = A[0] * p + A[1] * q + A[2] * r, v = A[3] * p + A[4] * q + A[5] * r;
        const w = A[6] * p + A[7] * q + A[8] * r;
        const facing = (u * light.x + v * light.y + w * light.z) / (Math.hypot(u, v, w) || 1);
        gain = 1 - light.strength + light.strength * (0.35 + 1.1 * Math.max(0, facing));
      }
      for (let i = 0; i < 3; i++)
        out[o + 12 + i] = (rgb[3 * n + i] + (add ? add[e + 3 + i] : 0)) * gain;
      if (shown === "weights" && this.trusted) {
        const weight = this.trusted[n], color = weight > 254 ? UNWEIGHED : ramp(weight / 254);
        for (let i = 0; i < 3; i++) out[o + 12 + i] = color[i];
      }
      if (marks && this.seen) {
        const unseen = 1 - this.seen[n] / 255;
        for (let i = 0; i < 3; i++) out[o + 12 + i] += unseen * (UNSEEN[i] - out[o + 12 + i]);
      }
    }
  }
}
