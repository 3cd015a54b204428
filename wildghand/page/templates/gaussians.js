// From the surfaces of the hands to their Gaussians, on the graphics card: the shadows that the hands
// cast, the layers of the network that see a pose, and what wildghand/model/dress.py makes of it.
"use strict";
const WIDTH = 2048; // Texels in a row of a texture.
const TILE = 256; // Texels along an edge of the depth image that one direction of light has.
const GLSL = `#version 300 es
precision highp float; precision highp int; precision highp sampler2D; precision highp sampler2DShadow;
uniform sampler2D gaussians, vertices, lights, darks, bones;
vec4 texel(sampler2D from, int i) { return texelFetch(from, ivec2(i % ${WIDTH}, i / ${WIDTH}), 0); }
`;
// Where a place lies in the depth image of a direction; nearer to the light is nearer to 0.
const TILED = `
uniform vec4 ball; uniform int tiles;
vec3 tiled(vec3 place, vec3 d, int k) {
  vec3 p = (place - ball.xyz) / ball.w;
  vec3 side = normalize(cross(d, abs(d.x) < 0.6 ? vec3(1, 0, 0) : vec3(0, 1, 0)));
  vec2 q = 0.97 * vec2(dot(p, side), dot(p, cross(d, side)));
  return vec3((vec2(k % tiles, k / tiles) + 0.5 + 0.5 * q) / float(tiles), 0.5 - 0.45 * dot(p, d));
}`;
const DEPTH = `${GLSL}${TILED}
void main() {
  vec3 at = tiled(texel(vertices, 2 * gl_VertexID).xyz, texel(lights, gl_InstanceID).xyz, gl_InstanceID);
  gl_Position = vec4(2.0 * at - 1.0, 1.0);
}`;
const NOTHING = `#version 300 es
precision highp float;
out vec4 color;
void main() { color = vec4(0); }`;
// wildghand/light: CastLight.darkening, at the vertices.
const DARK = `${GLSL}${TILED}
uniform sampler2DShadow depths; uniform int lamps; uniform float ambient;
out vec4 dark;
void main() {
  vec3 place = texel(vertices, 2 * gl_VertexID).xyz, n = texel(vertices, 2 * gl_VertexID + 1).xyz;
  float lit = ambient + 1e-3, whole = lit;
  for (int k = 0; k < lamps; k++) {
    vec4 lamp = texel(lights, k);
    float facing = dot(n, lamp.xyz), falling = max(facing, 0.0) * lamp.w;
    whole += falling;
    // A ray starts 2 mm from the skin.
    lit += facing > 0.02 ? falling * texture(depths, tiled(place + 2e-3 * n, lamp.xyz, k)) : falling;
  }
  dark = vec4(pow(clamp(lit / whole, 0.15, 1.0), 1.0 / 2.2));
}`;
// Texels of a Gaussian: 0 corners and the first share; 1 second share, whether it is near a wrist's
// border, what is kept of offset and shape; 2 to 5 attributes and uv; 6 place and mean weight; 7 shift, whether seen; 8 change of the colour.
const POSE = (P, H, first, second) => `${GLSL}
layout(std140) uniform First { vec4 one[${first}]; };
layout(std140) uniform Second { vec4 two[${second}]; };
vec4 weight(int i) { return i < ${first} ? one[i] : two[i - ${first}]; }
uniform int start, skin, middle; uniform bool networked, biased; uniform vec4 posture[${P}];
uniform vec4 disc[4], activation;
uniform ivec2 lamps; uniform vec2 ambient; uniform vec4 cap; uniform vec3 eye;
uniform vec4 mixing[56], shift[4], fields[32]; uniform vec3 gain;
uniform vec4 extra; uniform bool weighed, marked;
out vec4 a, b, c, d;
struct Place { vec3 at, normal, tangent; float dark; };
ivec3 corners(int row) { return ivec3(texel(gaussians, 9 * row).xyz); }
vec3 shares(int row) {
  float x = texel(gaussians, 9 * row).w, y = texel(gaussians, 9 * row + 1).x;
  return vec3(x, y, 1.0 - x - y);
}
Place place(int row) {
  ivec3 v = corners(row);
  vec3 w = shares(row), p = texel(vertices, 2 * v.x).xyz, q = texel(vertices, 2 * v.y).xyz;
  vec3 n = normalize(w.x * texel(vertices, 2 * v.x + 1).xyz + w.y * texel(vertices, 2 * v.y + 1).xyz
    + w.z * texel(vertices, 2 * v.z + 1).xyz);
  vec3 edge = q - p;
  float dark = w.x * texel(darks, v.x).x + w.y * texel(darks, v.y).x + w.z * texel(darks, v.z).x;
  return Place(w.x * p + w.y * q + w.z * texel(vertices, 2 * v.z).xyz, n,
    normalize(edge - dot(edge, n) * n), dark);
}
vec4 harmonics[4]; // wildghand/gaussians/shading.py, without the constant one
void harmonic(vec3 n) {
  float x = n.x, y = n.y, z = n.z, s = 3.872983346207417;
  harmonics[0] = vec4(1.7320508075688772 * n, s * x * y);
  harmonics[1] = vec4(s * y * z, s * x * z, 0.5 * s * (x * x - y * y), 1.118033988749895 * (3.0 * z * z - 1.0));
  harmonics[2] = vec4(2.091650066335189 * y * (3.0 * x * x - y * y), 10.246950765959598 * x * y * z,
    1.6201851746019651 * y * (5.0 * z * z - 1.0), 1.3228756555322954 * z * (5.0 * z * z - 3.0));
  harmonics[3] = vec4(1.6201851746019651 * x * (5.0 * z * z - 1.0), 5.123475382979799 * z * (x * x - y * y),
    2.091650066335189 * x * (x * x - 3.0 * y * y), 0.0);
}
vec4 raw[4]; float shadow;
vec4 silu(vec4 x) { return x / (1.0 + exp(-x)); }
// The geometry branch, and heads i and ii (wildghand/network), at one Gaussian with a normal.
void ask(int row, vec3 n) {
  int t = 9 * row, w = 0;
  for (int i = 0; i < 4; i++) raw[i] = texel(gaussians, t + 2 + i);
  vec2 uv = raw[3].zw;
  harmonic(n);
  if (!networked) { shadow = exp(uv.x); return; }
  vec3 p = texel(gaussians, t + 6).xyz;
  float x[20];
  x[0] = uv.x; x[1] = uv.y;
  for (int i = 0; i < 3; i++) for (int k = 0; k < 3; k++) {
    float angle = p[i] * float(1 << k);
    x[2 + 3 * i + k] = sin(angle); x[11 + 3 * i + k] = cos(angle);
  }
  vec4 h[${P}], g[${P}], k[${2 * H}];
  for (int o = 0; o < ${P}; o++) h[o] = posture[o];
  for (int i = 0; i < 20; i++) for (int o = 0; o < ${P}; o++) h[o] += x[i] * weight(w++);
  for (int i = 0; i < 4; i++) for (int q = 0; q < 4; q++) for (int o = 0; o < ${P}; o++)
    h[o] += harmonics[i][q] * weight(w++);
  for (int o = 0; o < ${P}; o++) g[o] = weight(w++);
  for (int i = 0; i < ${P}; i++) { vec4 s = silu(h[i]);
    for (int q = 0; q < 4; q++) for (int o = 0; o < ${P}; o++) g[o] += s[q] * weight(w++); }
  for (int o = 0; o < ${P}; o++) g[o] = silu(g[o]);
  for (int o = 0; o < ${2 * H}; o++) k[o] = weight(w++);
  for (int i = 0; i < 4; i++) for (int q = 0; q < 4; q++) for (int o = 0; o < ${2 * H}; o++)
    k[o] += harmonics[i][q] * weight(w++);
  for (int i = 0; i < ${P}; i++) for (int q = 0; q < 4; q++) for (int o = 0; o < ${2 * H}; o++)
    k[o] += g[i][q] * weight(w++);
  for (int o = 0; o < ${2 * H}; o++) k[o] = silu(k[o]);
  for (int i = 0; i < ${H}; i++) for (int q = 0; q < 4; q++) for (int o = 0; o < 4; o++)
    raw[o] += k[i][q] * weight(w++);
  float s = weight(w++).x;
  for (int o = 0; o < ${H}; o++) s += dot(k[${H} + o], weight(w++));
  for (int i = 0; i < 4; i++) s += dot(harmonics[i], weight(w++));
  for (int o = 0; o < ${P}; o++) s += dot(g[o], weight(w++));
  shadow = 1.0 / (1.0 + exp(-s));
}
float irradiance(vec3 n, int first, int count, float constant) {
  float sum = constant;
  for (int k = first; k < first + count; k++) {
    vec4 lamp = texel(lights, k);
    sum += max(dot(n, lamp.xyz), 0.0) * lamp.w;
  }
  return sum;
}
void askLit(int row, vec3 n) {
  ask(row, n);
  if (networked && lamps.x > 0)
    shadow *= pow(clamp(irradiance(n, 0, lamps.x, ambient.x), 0.15, 4.0), 1.0 / 2.2);
}
// wildghand/light: colours at normals that no frame has shown, from the nearest that one has.
void carryOn(int row, Place own) {
  float along = dot(own.normal, cap.xyz);
  float unknown = clamp((cap.w - along) / 0.1, 0.0, 1.0)
    * clamp(dot(normalize(eye - own.at), own.normal) / 0.2, 0.0, 1.0);
  if (!networked || lamps.y == 0 || unknown <= 0.0) return;
  vec4 before[4] = raw;
  float bright = max(shadow, 1e-4);
  vec3 across = own.normal - along * cap.xyz;
  vec3 known = normalize(cap.w * cap.xyz
    + sqrt(max(1.0 - cap.w * cap.w, 0.0)) * across / max(length(across), 1e-6));
  askLit(row, known);
  float ratio = max(irradiance(own.normal, lamps.x, lamps.y, ambient.y), 1e-3)
    / max(irradiance(known, lamps.x, lamps.y, ambient.y), 1e-3);
  float other = max(shadow * clamp(pow(ratio, 1.0 / 2.2), 0.2, 3.0), 1e-4);
  shadow = exp(mix(log(bright), log(other), unknown));
  before[2].w = mix(before[2].w, raw[2].w, unknown);
  before[3].xy = mix(before[3].xy, raw[3].xy, unknown);
  raw = before;
  harmonic(own.normal);
}
// wildghand/visibility: the nearer to a disc on the skin, the less frames say of a Gaussian.
void settle(vec2 kept, float facing, vec3 change) {
  if (kept.y <= 0.0) {
    float front = clamp(facing / 0.1, 0.0, 1.0);
    kept = max(kept, 1.0 - front);
    raw[2].w += front * change.x;
    raw[3].xy += front * change.yz;
  }
  vec4 q = vec4(raw[1].zw, raw[2].xy);
  q = normalize(q) * (q.x < 0.0 ? -1.0 : 1.0);
  q = vec4(1, 0, 0, 0) + kept.y * (q - vec4(1, 0, 0, 0));
  raw[0].xyz *= kept.x;
  raw[0].w = mix(disc[0].w, raw[0].w, kept.y);
  raw[1] = vec4(mix(disc[1].xy, raw[1].xy, kept.y), q.xy);
  raw[2].xy = q.zw;
  raw[2].z = mix(max(raw[2].z, disc[2].z), raw[2].z, kept.y);
}
// wildghand/dpd: omega is in all of the numbers already.
void perturb(int row) {
  vec4 add[4];
  for (int o = 0; o < 4; o++) add[o] = shift[o];
  for (int i = 0; i < 14; i++) for (int o = 0; o < 4; o++) add[o] += raw[i / 4][i % 4] * mixing[4 * i + o];
  for (int i = 0; i < 8; i++) for (int o = 0; o < 4; o++) add[o] += harmonics[i / 4][i % 4] * fields[4 * i + o];
  ivec3 v = corners(row);
  vec3 w = shares(row);
  for (int j = 0; j < 3; j++) for (int o = 0; o < 4; o++) add[o] += w[j] * texel(bones, 4 * v[j] + o);
  for (int o = 0; o < 4; o++) raw[o] += add[o];
}
vec3 ramp(float share) {
  vec3 colors[5] = vec3[](vec3(0.27, 0.0, 0.33), vec3(0.23, 0.32, 0.55), vec3(0.13, 0.57, 0.55),
    vec3(0.37, 0.79, 0.38), vec3(0.99, 0.91, 0.14));
  int low = min(int(share * 4.0), 3);
  return mix(colors[low], colors[low + 1], share * 4.0 - float(low));
}
void main() {
  int row = start + gl_VertexID, t = 9 * row;
  vec4 info = texel(gaussians, t + 7);
  Place own = place(row);
  // The discs in a wrist are as they are.
  bool wall = gl_VertexID >= skin;
  if (wall) {
    for (int i = 0; i < 4; i++) raw[i] = texel(gaussians, t + 2 + i);
    shadow = 1.0;
  } else {
    askLit(row, own.normal);
    carryOn(row, own);
    float facing = dot(normalize(eye - own.at), own.normal);
    settle(texel(gaussians, t + 1).zw, facing, texel(gaussians, t + 8).xyz);
    if (biased) perturb(row);
  }
  vec3 color = shadow * own.dark * gain / (1.0 + exp(-vec3(raw[2].w, raw[3].xy)));
  if (extra.w > 0.0)
    color *= 1.0 - extra.w + extra.w * (0.35 + 1.1 * max(0.0, dot(own.normal, extra.xyz)));
  float weight = texel(gaussians, t + 6).w;
  if (weighed) color = weight > 1.0 ? vec3(0.6) : ramp(weight);
  if (marked) color = mix(vec3(0.55, 0.2, 0.85), color, info.w);
  mat3 frame = mat3(own.tangent, cross(own.normal, own.tangent), own.normal);
  vec3 mean = own.at + frame * (activation.x * tanh(0.5 * raw[0].xyz) + info.xyz);
  vec4 q = normalize(vec4(raw[1].zw, raw[2].xy));
  vec3 scales = exp(clamp(vec3(raw[0].w, raw[1].xy) + activation.y, activation.z, activation.w));
  mat3 turn = frame * mat3(
    1.0 - 2.0 * (q.z * q.z + q.w * q.w), 2.0 * (q.y * q.z + q.x * q.w), 2.0 * (q.y * q.w - q.x * q.z),
    2.0 * (q.y * q.z - q.x * q.w), 1.0 - 2.0 * (q.y * q.y + q.w * q.w), 2.0 * (q.z * q.w + q.x * q.y),
    2.0 * (q.y * q.w + q.x * q.z), 2.0 * (q.z * q.w - q.x * q.y), 1.0 - 2.0 * (q.y * q.y + q.z * q.z));
  mat3 half_ = mat3(turn[0] * scales.x, turn[1] * scales.y, turn[2] * scales.z);
  // wildghand/model/wrist.py: skin of a wrist ends before the plane of its border.
  if (middle >= 0 && texel(gaussians, t + 1).y > 0.0) {
    vec3 n = texel(vertices, 2 * middle + 1).xyz;
    float depth = dot(mean - texel(vertices, 2 * middle).xyz, n), room = max(depth, 3e-4);
    float kept = room / max(3.0 * length(n * half_), 1e-9);
    if (kept < 1.0) {
      mean += (room - depth) * n;
      half_ -= (1.0 - kept) * outerProduct(n, n * half_);
    }
  }
  mat3 S = half_ * transpose(half_);
  a = vec4(mean, 1.0 / (1.0 + exp(-raw[2].z)));
  b = vec4(S[0][0], S[0][1], S[0][2], S[1][1]);
  c = vec4(S[1][2], S[2][2], 0.0, 0.0);
  d = vec4(color, 0.0);
}`;

class Gaussians {
  constructor(gl, content, hands) {
    Object.assign(this, { gl, content, hands });
    this.count = hands.reduce((sum, hand) => sum + hand.count, 0);
    const vertices = hands.reduce((sum, hand) => sum + hand.vertices, 0);
    const { cast, known } = content.light, network = content.network;
    this.lamps = [cast ? cast.lamps.length : 0, known ? known.lamps.length : 0];
    const lights = [...(cast ? cast.lamps : []), ...(known ? known.lamps : []), [0, 0, 0, 0]].flat();
    this.textures = {
      gaussians: this.texture(this.static()),
      vertices: this.texture(new Float32Array(8 * vertices)),
      lights: this.texture(Float32Array.from(lights)),
      darks: this.texture(new Float32Array(4 * vertices).fill(1)),
      bones: this.texture(new Float32Array(16 * vertices)),
      made: this.texture(new Float32Array(16 * this.count)),
    };
    this.vertices = vertices;
    this.surface = new Float32Array(8 * vertices);
    this.data = new Float32Array(16 * this.count);
    const P = network ? network.points : 1, H = network ? network.hidden : 1;
    const weights = network ? unpack(network.weights, Float32Array) : new Float32Array(4);
    const first = Math.min(1024, weights.length / 4), second = Math.max(1, weights.length / 4 - first);
    this.poser = compile(gl, [POSE(P, H, first, second), NOTHING], ["a", "b", "c", "d"]);
    ["First", "Second"].forEach((name, i) => {
      const buffer = gl.createBuffer(), block = new Float32Array(4 * (i ? second : first));
      block.set(weights.subarray(i ? 4 * first : 0, i ? undefined : 4 * first));
      gl.bindBuffer(gl.UNIFORM_BUFFER, buffer);
      gl.bufferData(gl.UNIFORM_BUFFER, block, gl.STATIC_DRAW);
      gl.bindBufferBase(gl.UNIFORM_BUFFER, i, buffer);
      gl.uniformBlockBinding(this.poser, gl.getUniformBlockIndex(this.poser, name), i);
    });
    if (network) this.posture = linear(network.posture);
    this.made = this.buffer(16 * this.count);
    this.bare = gl.createVertexArray();
    if (cast) this.makeShadows();
  }
  buffer(floats) {
    // As long as the rows of the texture that it is copied to.
    const gl = this.gl, buffer = gl.createBuffer(), row = 4 * WIDTH;
    gl.bindBuffer(gl.TRANSFORM_FEEDBACK_BUFFER, buffer);
    gl.bufferData(gl.TRANSFORM_FEEDBACK_BUFFER, 4 * row * Math.ceil(floats / row), gl.DYNAMIC_READ);
    gl.bindBuffer(gl.TRANSFORM_FEEDBACK_BUFFER, null);
    return buffer;
  }
  texture(data) {
    const gl = this.gl, rows = Math.ceil(data.length / 4 / WIDTH), name = nearest(gl);
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA32F, WIDTH, rows);
    const texture = { name, rows, data: new Float32Array(4 * WIDTH * rows) };
    this.upload(texture, data);
    return texture;
  }
  upload(texture, data) {
    const gl = this.gl;
    texture.data.set(data);
    gl.bindTexture(gl.TEXTURE_2D, texture.name);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, WIDTH, texture.rows, gl.RGBA, gl.FLOAT, texture.data);
  }
  // Run a vertex shader once for each of `count` rows of some floats, from row `first` of a buffer.
  run(count, buffer, first, floats) {
    const gl = this.gl;
    gl.bindVertexArray(this.bare);
    gl.enable(gl.RASTERIZER_DISCARD);
    gl.bindBufferRange(gl.TRANSFORM_FEEDBACK_BUFFER, 0, buffer, 4 * floats * first, 4 * floats * count);
    gl.beginTransformFeedback(gl.POINTS);
    gl.drawArrays(gl.POINTS, 0, count);
    gl.endTransformFeedback();
    gl.bindBufferBase(gl.TRANSFORM_FEEDBACK_BUFFER, 0, null);
    gl.disable(gl.RASTERIZER_DISCARD);
  }
  copy(buffer, texture) {
    const gl = this.gl;
    gl.bindBuffer(gl.PIXEL_UNPACK_BUFFER, buffer);
    gl.bindTexture(gl.TEXTURE_2D, texture.name);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, WIDTH, texture.rows, gl.RGBA, gl.FLOAT, 0);
    gl.bindBuffer(gl.PIXEL_UNPACK_BUFFER, null);
  }
  use(program, names) {
    const gl = this.gl;
    gl.useProgram(program);
    names.forEach((name, unit) => {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(gl.TEXTURE_2D, this.textures[name].name);
      gl.uniform1i(gl.getUniformLocation(program, name), unit);
    });
    gl.activeTexture(gl.TEXTURE0 + names.length);
    return (name) => gl.getUniformLocation(program, name);
  }
  // The texels of all Gaussians that no pose changes.
  static() {
    const out = new Float32Array(36 * this.count);
    let row = 0, vertex = 0;
    for (const hand of this.hands) {
      const { data, corners, mix } = hand;
      const base = whole(data.base), places = whole(data.places), shifts = whole(data.shifts);
      const changes = whole(data.changes);
      const kept = unpack(data.kept, Uint8Array), trusted = data.trusted && unpack(data.trusted, Uint8Array);
      Object.assign(hand, { first: row, firstVertex: vertex });
      for (let n = 0, o = 36 * row; n < hand.count; n++, o += 36) {
        const skin = n < hand.skin, k = kept[2 * n] / 255, shown = kept[2 * n + 1] ? k : 0;
        for (let i = 0; i < 3; i++) out[o + i] = corners[3 * n + i] + vertex;
        const shares = [mix[2 * n] / 65535, mix[2 * n + 1] / 65535];
        out.set([...shares, 0, k, kept[2 * n + 1] / 255], o + 3);
        out.set(base.subarray(14 * n, 14 * n + 14), o + 8);
        if (skin) out.set(places.subarray(5 * n, 5 * n + 5), o + 22);
        // Of frames f and their half h a fit keeps k = f / (f + h); it has seen f / h.
        const weight = trusted && trusted[n] < 255 ? trusted[n] / 254 : 2;
        out.set([weight, ...shifts.subarray(3 * n, 3 * n + 3), Math.min(shown / Math.max(1 - shown, 1e-6), 1)], o + 27);
        out.set(changes.subarray(3 * n, 3 * n + 3), o + 32);
      }
      for (const n of data.lenders) out[36 * (row + n) + 5] = 1;
      row += hand.count;
      vertex += hand.vertices;
    }
    return out;
  }
  makeShadows() {
    const gl = this.gl, [count] = this.lamps;
    this.tiles = Math.ceil(Math.sqrt(count));
    this.deepener = compile(gl, [DEPTH, NOTHING]);
    this.darkener = compile(gl, [DARK, NOTHING], ["dark"]);
    const indices = this.hands.flatMap((hand) => Array.from(hand.faces, (v) => v + hand.firstVertex));
    this.indices = indices.length;
    this.mesh = gl.createVertexArray();
    gl.bindVertexArray(this.mesh);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, Uint32Array.from(indices), gl.STATIC_DRAW);
    gl.bindVertexArray(null);
    this.depths = nearest(gl);
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.DEPTH_COMPONENT24, TILE * this.tiles, TILE * this.tiles);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.LINEAR);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_COMPARE_MODE, gl.COMPARE_REF_TO_TEXTURE);
    this.depthTarget = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.depthTarget);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.TEXTURE_2D, this.depths, 0);
    gl.drawBuffers([gl.NONE]);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    this.darks = this.buffer(4 * this.vertices);
  }
  castShadows() {
    const gl = this.gl, edge = TILE * this.tiles, low = [9, 9, 9], high = [-9, -9, -9], at = this.surface;
    for (let o = 0; o < at.length; o += 8)
      for (let i = 0; i < 3; i++) {
        low[i] = Math.min(low[i], at[o + i]);
        high[i] = Math.max(high[i], at[o + i]);
      }
    const centre = low.map((v, i) => (v + high[i]) / 2);
    let radius = 0;
    for (let o = 0; o < at.length; o += 8)
      radius = Math.max(radius, Math.hypot(at[o] - centre[0], at[o + 1] - centre[1], at[o + 2] - centre[2]));
    const ball = [...centre, radius + 0.003];
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.depthTarget);
    gl.viewport(0, 0, edge, edge);
    gl.enable(gl.DEPTH_TEST);
    gl.clear(gl.DEPTH_BUFFER_BIT);
    let uniform = this.use(this.deepener, ["vertices", "lights"]);
    gl.uniform4fv(uniform("ball"), ball);
    gl.uniform1i(uniform("tiles"), this.tiles);
    gl.bindVertexArray(this.mesh);
    gl.drawElementsInstanced(gl.TRIANGLES, this.indices, gl.UNSIGNED_INT, 0, this.lamps[0]);
    gl.disable(gl.DEPTH_TEST);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    uniform = this.use(this.darkener, ["vertices", "lights"]);
    gl.bindTexture(gl.TEXTURE_2D, this.depths);
    gl.uniform1i(uniform("depths"), 2);
    gl.uniform4fv(uniform("ball"), ball);
    gl.uniform1i(uniform("tiles"), this.tiles);
    gl.uniform1i(uniform("lamps"), this.lamps[0]);
    gl.uniform1f(uniform("ambient"), this.content.light.cast.ambient);
    this.run(this.vertices, this.darks, 0, 4);
    this.copy(this.darks, this.textures.darks);
  }
  // Pose all hands, turned together (row-major 3x3, or null) about a place.
  // look: eye (3), extra [x, y, z, strength], shown, marked.
  pose(turn, centre, look) {
    const gl = this.gl, poses = this.hands.map((hand) => hand.turned(turn, centre));
    const postures = poses.map(({ vectors }) => this.postureOf(vectors));
    const refined = this.hands.map((hand, i) => hand.refined(poses[i], this.surface, postures[i]));
    this.hands.forEach((hand, i) => hand.write(this.surface, hand.firstVertex, refined[i]));
    this.upload(this.textures.vertices, this.surface);
    if (this.lamps[0]) this.castShadows();
    this.hands.forEach((hand, i) => this.poseHand(hand, poses[i].turns, postures[i], look));
    // They are sorted here, and the discs in a wrist get the median colour of the skin around it.
    gl.bindBuffer(gl.COPY_READ_BUFFER, this.made);
    gl.getBufferSubData(gl.COPY_READ_BUFFER, 0, this.data);
    gl.bindBuffer(gl.COPY_READ_BUFFER, null);
    for (const { first, skin, count, data } of this.hands)
      for (let c = 12; c < 15 && look.shown !== "weights" && data.lenders.length; c++) {
        const found = Float32Array.from(data.lenders, (n) => this.data[16 * (first + n) + c]).sort();
        const median = found[(found.length - 1) >> 1];
        for (let n = first + skin; n < first + count; n++) this.data[16 * n + c] = median;
      }
    this.upload(this.textures.made, this.data);
  }
  poseHand(hand, turns, posture, look) {
    const gl = this.gl, { network, light } = this.content;
    if (hand.table) this.fill(hand, hand.table.at(turns));
    const biased = look.shown === "biases" && hand.data.biases;
    if (biased) this.prepareBiases(hand);
    const at = this.use(this.poser, ["gaussians", "vertices", "lights", "darks", "bones"]);
    gl.uniform1i(at("start"), hand.first);
    gl.uniform1i(at("skin"), hand.skin);
    const middle = hand.border.length && !biased ? hand.firstVertex + hand.rest.length / 3 : -1;
    gl.uniform1i(at("middle"), middle);
    gl.uniform1i(at("networked"), network ? 1 : 0);
    if (network) gl.uniform4fv(at("posture"), posture);
    gl.uniform4fv(at("disc"), [...hand.data.disc, 0, 0]);
    gl.uniform4fv(at("activation"), hand.data.activation);
    gl.uniform2iv(at("lamps"), this.lamps);
    gl.uniform2f(at("ambient"), light.cast ? light.cast.ambient : 0, light.known ? light.known.ambient : 0);
    gl.uniform4fv(at("cap"), light.known ? light.known.cap : [0, 0, 1, -1]);
    gl.uniform3fv(at("eye"), look.eye);
    gl.uniform4fv(at("extra"), look.extra);
    gl.uniform1i(at("weighed"), look.shown === "weights" && hand.data.trusted ? 1 : 0);
    gl.uniform1i(at("marked"), look.marked && hand.data.seen ? 1 : 0);
    gl.uniform1i(at("biased"), biased ? 1 : 0);
    gl.uniform3fv(at("gain"), biased ? biased.gains[hand.frame] : [1, 1, 1]);
    if (biased) {
      const { mixing, shift, fields } = hand.bias;
      gl.uniform4fv(at("mixing"), mixing);
      gl.uniform4fv(at("shift"), shift);
      gl.uniform4fv(at("fields"), fields);
    }
    this.run(hand.count, this.made, hand.first, 16);
  }
  // The encoded pose through its layer: sines and cosines of pi 2^k v / (2 pi).
  postureOf(vectors) {
    if (!this.posture) return [];
    const angles = vectors.flat().flatMap((v) =>
      Array.from({ length: this.content.network.frequencies }, (_, k) => 0.5 * v * 2 ** k));
    return this.posture([...angles.map(Math.sin), ...angles.map(Math.cos)]);
  }
  // Put 15 numbers of each Gaussian of the skin into its texels: attributes, and the log of the shadow.
  fill(hand, values) {
    const { data } = this.textures.gaussians;
    for (let n = 0; n < hand.skin; n++)
      data.set(values.subarray(15 * n, 15 * n + 15), 36 * (hand.first + n) + 8);
    this.upload(this.textures.gaussians, data);
  }
  // A frame's biases, all multiplied by omega; the part of the field that bones have, at the vertices.
  prepareBiases(hand) {
    const { data, frame } = hand, given = data.biases, omega = given.omega[frame];
    const scaled = (values) => values.map((v) => v * omega);
    if (!hand.bias) {
      hand.bias = { all: unpack(given.mixing, Float32Array), shifts: unpack(given.shifts, Float32Array) };
      hand.bias.maps = unpack(given.maps, Float32Array);
    }
    const { bias } = hand, field = new Float32Array(24 * 16);
    given.codes[frame].forEach((code, k) => {
      for (let i = 0; i < 384; i++) field[i] += omega * code * bias.maps[384 * k + i];
    });
    bias.mixing = scaled(bias.all);
    bias.shift = scaled(bias.shifts.slice(16 * frame, 16 * frame + 16));
    bias.fields = field.subarray(256);
    const out = this.textures.bones.data;
    for (let v = 0; v < hand.rest.length / 3; v++) {
      const o = 16 * (hand.firstVertex + v);
      out.fill(0, o, o + 16);
      for (let k = 4 * v; k < 4 * v + 4; k++)
        for (let i = 0; i < 16; i++) out[o + i] += 4 * hand.weights[k] * field[16 * hand.bones[k] + i];
    }
    this.upload(this.textures.bones, out);
  }
}
