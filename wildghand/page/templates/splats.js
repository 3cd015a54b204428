// Draws Gaussians with WebGL2, by the conventions of wildghand/splat/conventions.py.
"use strict";

const VERTEX = `#version 300 es
precision highp float; precision highp int; precision highp sampler2D;
uniform sampler2D data;
uniform mat3 turn; uniform vec3 shift;
uniform vec4 lens; // fx, fy, cx, cy
uniform vec2 size;
in uint which;
flat out vec2 centre; flat out vec3 conic; flat out vec4 paint;
vec4 texel(uint i) { return texelFetch(data, ivec2(int(i % ${WIDTH}u), int(i / ${WIDTH}u)), 0); }
void main() {
  uint i = 4u * which;
  vec4 a = texel(i), b = texel(i + 1u), c = texel(i + 2u), d = texel(i + 3u);
  vec3 p = turn * a.xyz + shift;
  gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
  if (p.z < 0.01 || a.w * 255.0 <= 1.0) return;
  mat3 S = turn * mat3(b.x, b.y, b.z, b.y, b.w, c.x, b.z, c.x, c.y) * transpose(turn);
  vec2 margin = 0.15 * size / lens.xy;
  vec2 ray = clamp(p.xy / p.z, -lens.zw / lens.xy - margin, (size - lens.zw) / lens.xy + margin);
  vec3 u = vec3(lens.x / p.z, 0.0, -lens.x * ray.x / p.z);
  vec3 v = vec3(0.0, lens.y / p.z, -lens.y * ray.y / p.z);
  vec3 Su = S * u, Sv = S * v;
  float xx = dot(u, Su) + 0.3, xy = dot(u, Sv), yy = dot(v, Sv) + 0.3;
  float det = xx * yy - xy * xy;
  if (!(det > 0.0)) return;
  centre = lens.xy * p.xy / p.z + lens.zw;
  conic = vec3(yy, -xy, xx) / det;
  paint = vec4(d.rgb, a.w);
  // The ellipse in which alpha is at least 1/255.
  float reach = 2.0 * log(255.0 * a.w);
  vec2 corner = vec2(gl_VertexID & 1, gl_VertexID >> 1) * 2.0 - 1.0;
  vec2 place = centre + corner * (sqrt(reach * vec2(xx, yy)) + 1.0);
  gl_Position = vec4(place / size * vec2(2.0, -2.0) + vec2(-1.0, 1.0), 0.0, 1.0);
}`;
const FRAGMENT = `#version 300 es
precision highp float;
uniform vec2 size;
flat in vec2 centre; flat in vec3 conic; flat in vec4 paint;
out vec4 color;
void main() {
  vec2 d = vec2(gl_FragCoord.x, size.y - gl_FragCoord.y) - centre;
  float power = 0.5 * (conic.x * d.x * d.x + conic.z * d.y * d.y) + conic.y * d.x * d.y;
  float alpha = min(0.999, paint.a * exp(-power));
  if (power < 0.0 || alpha < 1.0 / 255.0) discard;
  color = vec4(paint.rgb * alpha, alpha);
}`;
const WHOLE = `#version 300 es
void main() { gl_Position = vec4(vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4.0 - 1.0, 0.0, 1.0); }`;
const COMPOSE = `#version 300 es
precision highp float;
uniform sampler2D drawn; uniform vec3 background; uniform vec2 size; uniform float soft;
out vec4 color;
void main() {
  vec4 c = texelFetch(drawn, ivec2(gl_FragCoord.xy), 0);
  // Brightest a little above the middle.
  float away = length((gl_FragCoord.xy - size * vec2(0.5, 0.56)) / max(size.x, size.y));
  vec3 behind = background * (1.0 - soft * smoothstep(0.0, 0.75, away));
  color = vec4(clamp(c.rgb + (1.0 - c.a) * behind, 0.0, 1.0), 1.0);
}`;

function compile(gl, sources, varyings) {
  const made = gl.createProgram();
  sources.forEach((source, i) => {
    const shader = gl.createShader(i ? gl.FRAGMENT_SHADER : gl.VERTEX_SHADER);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    gl.attachShader(made, shader);
  });
  if (varyings) gl.transformFeedbackVaryings(made, varyings, gl.INTERLEAVED_ATTRIBS);
  gl.linkProgram(made);
  if (!gl.getProgramParameter(made, gl.LINK_STATUS)) {
    const logs = gl.getAttachedShaders(made).map((shader) => gl.getShaderInfoLog(shader));
    throw new Error([gl.getProgramInfoLog(made), ...logs].join(" "));
  }
  return made;
}
function nearest(gl) {
  const texture = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, texture);
  for (const side of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER])
    gl.texParameteri(gl.TEXTURE_2D, side, gl.NEAREST);
  return texture;
}

class Splats {
  constructor(canvas, content, hands) {
    const gl = canvas.getContext("webgl2", { antialias: false, alpha: false });
    if (!gl) throw new Error("WebGL2 is absent");
    this.gl = gl;
    this.gaussians = new Gaussians(gl, content, hands);
    const { count } = this.gaussians;
    this.count = count;
    this.order = new Uint32Array(count);
    this.scratch = new Uint32Array(count);
    this.depths = new Float32Array(count);
    this.keys = new Uint32Array(this.depths.buffer);
    // Eight bits a layer would round away faint splats; without floats they must do.
    const full = gl.getExtension("EXT_color_buffer_float");
    const half = full || gl.getExtension("EXT_color_buffer_half_float");
    const blends = full && gl.getExtension("EXT_float_blend");
    this.format = blends ? gl.RGBA32F : half ? gl.RGBA16F : gl.RGBA8;
    this.painter = compile(gl, [VERTEX, FRAGMENT]);
    this.composer = compile(gl, [WHOLE, COMPOSE]);
    this.target = gl.createFramebuffer();
    this.shapes = gl.createVertexArray();
    gl.bindVertexArray(this.shapes);
    this.buffer = gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, this.buffer);
    const which = gl.getAttribLocation(this.painter, "which");
    gl.enableVertexAttribArray(which);
    gl.vertexAttribIPointer(which, 1, gl.UNSIGNED_INT, 0, 0);
    gl.vertexAttribDivisor(which, 1);
    this.empty = gl.createVertexArray();
  }
  // Far to near; of equal depths the later index first, since it lies behind.
  sort(view) {
    const { count, depths, keys } = this, [a, b, c] = view.turn.slice(6), t = view.shift[2];
    const { data } = this.gaussians;
    for (let n = 0, o = 0; n < count; n++, o += 16) {
      const z = a * data[o] + b * data[o + 1] + c * data[o + 2] + t;
      depths[n] = z > 0 ? z : 0;
    }
    // Bits of positive floats sort as integers do.
    let from = this.order, to = this.scratch;
    for (let n = 0; n < count; n++) from[n] = count - 1 - n;
    for (const bits of [0, 16]) {
      const starts = new Uint32Array(65537);
      for (let n = 0; n < count; n++) starts[65536 - ((keys[n] >>> bits) & 65535)]++;
      for (let i = 1; i < 65537; i++) starts[i] += starts[i - 1];
      for (let i = 0; i < count; i++) {
        const key = 65536 - ((keys[from[i]] >>> bits) & 65535);
        to[starts[key - 1]++] = from[i];
      }
      [from, to] = [to, from];
    }
  }
  resize(width, height) {
    const gl = this.gl, canvas = gl.canvas;
    if (this.drawn && canvas.width === width && canvas.height === height) return;
    canvas.width = width;
    canvas.height = height;
    if (this.drawn) gl.deleteTexture(this.drawn);
    this.drawn = nearest(gl);
    gl.texStorage2D(gl.TEXTURE_2D, 1, this.format, width, height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, this.drawn, 0);
  }
  // view: turn (9) and shift (3), world to camera; lens [fx, fy, cx, cy] px; width, height px.
  // background: colour, and by how much it is darker at its edge.
  draw(view, background, soft) {
    const gl = this.gl, { width, height } = view;
    gl.activeTexture(gl.TEXTURE0);
    this.resize(width, height);
    this.sort(view);
    gl.viewport(0, 0, width, height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.useProgram(this.painter);
    const at = (name) => gl.getUniformLocation(this.painter, name);
    gl.uniformMatrix3fv(at("turn"), true, view.turn);
    gl.uniform3fv(at("shift"), view.shift);
    gl.uniform4fv(at("lens"), view.lens);
    gl.uniform2f(at("size"), width, height);
    gl.bindTexture(gl.TEXTURE_2D, this.gaussians.textures.made.name);
    gl.bindVertexArray(this.shapes);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.buffer);
    gl.bufferData(gl.ARRAY_BUFFER, this.order, gl.DYNAMIC_DRAW);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, this.count);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.disable(gl.BLEND);
    gl.useProgram(this.composer);
    gl.uniform3fv(gl.getUniformLocation(this.composer, "background"), background);
    gl.uniform2f(gl.getUniformLocation(this.composer, "size"), width, height);
    gl.uniform1f(gl.getUniformLocation(this.composer, "soft"), soft);
    gl.bindTexture(gl.TEXTURE_2D, this.drawn);
    gl.bindVertexArray(this.empty);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }
  // Red, green and blue of every pixel, row by row from the top; right after `draw`.
  pixels() {
    const gl = this.gl, { width, height } = gl.canvas, raw = new Uint8Array(4 * width * height);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, raw);
    const out = [];
    for (let y = height - 1; y >= 0; y--)
      for (let x = 0; x < width; x++) out.push(...raw.subarray(4 * (y * width + x), 4 * (y * width + x) + 3));
    return out;
  }
}
