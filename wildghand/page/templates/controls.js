// The page's controls, and `window.avatar` for scripts.
"use strict";
const FINGERS = { thumb: 13, index: 1, middle: 4, ring: 10, little: 7 };
const ANGLES = ["bend", "sideways", "twist"];
// Degrees from rest: bend of a finger's three joints, then sideways at its first.
const CLOSED = [75, 95, 55, 0];
const POSES = {
  rest: {},
  fist: { thumb: [25, 30, 40, -10], index: CLOSED, middle: CLOSED, ring: CLOSED, little: CLOSED },
  point: { thumb: [25, 30, 40, -10], middle: CLOSED, ring: CLOSED, little: CLOSED },
  pinch: { thumb: [28, 10, 25, 12], index: [52, 42, 25, 0], middle: [12, 15, 8, 0] },
  spread: { thumb: [-25, -8, 0, 10], index: [-6, 0, 0, 16], middle: [-6, 0, 0, 3],
            ring: [-6, 0, 0, -10], little: [-6, 0, 0, -22] },
};
const one = (name) => document.getElementById(name);
const content = JSON.parse(one("content").textContent);

function start() {
  const hands = content.hands.map((data) => new Hand(data));
  const canvas = one("view");
  const splats = new Splats(canvas, content, hands);
  const base = Float64Array.from(content.viewmat.slice(0, 3).flatMap((row) => row.slice(0, 3)));
  const eye = { yaw: 0, pitch: 0, distance: 1, centre: [0, 0, 0] };
  const state = { camera: null, dirty: true, playing: false, turning: 0, soft: true, frame: 0, sliders: [] };
  let radius = 0.1;

  // The hand turns and not the camera, so that its light is the one that frames have shown.
  function turned() {
    if (state.camera || (!eye.yaw && !eye.pitch)) return null;
    const inner = product(rotation([eye.pitch, 0, 0]), rotation([0, eye.yaw, 0]));
    return product(product(transposed(base), inner), base);
  }
  function centre() {
    const places = hands.flatMap((hand) => hand.chain(hand.turned(null)).places);
    return [0, 1, 2].map((i) => {
      const all = places.map((p) => p[i]);
      return (Math.min(...all) + Math.max(...all)) / 2;
    });
  }
  function lightOf() {
    if (!one("relight").checked) return [0, 0, 0, 0];
    const angle = (one("angle").value * Math.PI) / 180, high = (one("height").value * Math.PI) / 180;
    const seen = [Math.sin(angle) * Math.cos(high), -Math.sin(high), -Math.cos(angle) * Math.cos(high)];
    return [...apply(transposed(base), seen), one("strength").value / 100];
  }
  function view() {
    if (state.camera) return state.camera;
    const ratio = Math.min(window.devicePixelRatio || 1, 2);
    const width = Math.max(1, Math.round(canvas.clientWidth * ratio));
    const height = Math.max(1, Math.round(canvas.clientHeight * ratio));
    const moved = apply(base, eye.centre), focal = 2 * Math.min(width, height);
    const shift = [-moved[0], -moved[1], eye.distance - moved[2]];
    return { turn: Array.from(base), shift, lens: [focal, focal, width / 2, height / 2], width, height };
  }
  function background() {
    const text = one("background").value;
    return [1, 3, 5].map((i) => parseInt(text.slice(i, i + 2), 16) / 255);
  }
  function pose() {
    eye.centre = centre();
    const at = view(), back = transposed(Float64Array.from(at.turn));
    splats.gaussians.pose(turned(), eye.centre, {
      eye: apply(back, at.shift).map((v) => -v),
      extra: lightOf(), shown: one("shown").value, marked: one("unseen").checked,
    });
    return at;
  }
  function draw() {
    state.dirty = false;
    splats.draw(pose(), background(), state.soft ? 0.14 : 0);
  }
  function changed() {
    if (!state.dirty) { state.dirty = true; requestAnimationFrame(draw); }
  }
  function fit() {
    Object.assign(eye, { yaw: 0, pitch: 0 });
    pose();
    const { data } = splats.gaussians;
    radius = 0;
    for (let o = 0; o < data.length; o += 16)
      radius = Math.max(radius, Math.hypot(...eye.centre.map((c, i) => c - data[o + i])));
    eye.distance = (radius * 4) / 0.85;
  }
  // Slowly around, once in 24 seconds, until something is touched or the browser is too slow for it.
  let late = 0;
  function rest() { state.turning = 0; }
  function spin(now, before) {
    late = now - before > 200 ? late + 1 : 0;
    if (late > 3) rest();
    if (!state.turning) return;
    eye.yaw += (Math.min(now - before, 100) / 24000) * 2 * Math.PI;
    draw();
    state.turning = requestAnimationFrame((next) => spin(next, now));
  }

  // Sliders: a group for each finger, and one for the wrist, of each hand.
  function slider(parent, hand, joint, part, low, high, label) {
    const row = parent.appendChild(document.createElement("label"));
    const input = document.createElement("input"), shown = document.createElement("output");
    row.append(label, input, shown);
    Object.assign(input, { type: "range", min: low, max: high, step: 0.5 });
    Object.assign(input.dataset, { side: hand.side, joint, part });
    const found = { hand, joint, part, input, shown };
    input.addEventListener("input", () => {
      play(false);
      state.camera = null;
      const row = state.sliders.filter((s) => s.hand === hand && s.joint === joint);
      const degrees = row.map((s) => +s.input.value);
      if (joint) hand.setAngles(joint, degrees); else hand.setWrist(degrees);
      shown.textContent = `${(+input.value).toFixed(0)}°`;
      changed();
    });
    state.sliders.push(found);
  }
  function group(parent, title) {
    const box = parent.appendChild(document.createElement("details"));
    box.appendChild(document.createElement("summary")).textContent = title;
    return box;
  }
  for (const hand of hands) {
    const named = hands.length > 1 ? `${hand.side} ` : "";
    const wrist = group(one("joints"), `${named}wrist`);
    ["x", "y", "z"].forEach((axis, i) => slider(wrist, hand, 0, i, -180, 180, `turn about ${axis}`));
    for (const [finger, first] of Object.entries(FINGERS)) {
      const box = group(one("joints"), named + finger);
      for (let joint = first; joint < first + 3; joint++)
        ANGLES.forEach((angle, i) => slider(box, hand, joint, i, hand.lower[joint - 1][i],
          hand.upper[joint - 1][i], `joint ${joint - first + 1} ${angle}`));
    }
  }
  function showAngles() {
    for (const { hand, joint, part, input, shown } of state.sliders) {
      const angle = joint ? hand.angles(joint)[part] : (hand.vectors[0][part] * 180) / Math.PI;
      input.value = angle;
      shown.textContent = `${angle.toFixed(0)}°`;
    }
  }
  function setPose(poses) {
    play(false);
    for (const hand of hands) if (poses[hand.side]) hand.setPose(...poses[hand.side]);
    showAngles();
    changed();
  }
  function setNamed(name) {
    play(false);
    for (const hand of hands)
      for (const [finger, first] of Object.entries(FINGERS))
        for (let i = 0; i < 3; i++) {
          const given = POSES[name][finger] || [0, 0, 0, 0], joint = first + i;
          const angles = [given[i], i ? 0 : given[3], 0];
          hand.setAngles(joint, angles.map((a, k) =>
            Math.min(Math.max(a, hand.lower[joint - 1][k]), hand.upper[joint - 1][k])));
        }
    showAngles();
    changed();
  }
  for (const name of Object.keys(POSES)) {
    const button = one("poses").appendChild(document.createElement("button"));
    button.textContent = name;
    button.addEventListener("click", () => setNamed(name));
  }

  // The motion of the training frames.
  const frames = content.frames.length;
  let timer = 0;
  function setFrame(frame) {
    state.frame = frame;
    for (const hand of hands) hand.setFrame(frame);
    one("time").value = frame;
    const facts = [`frame ${content.frames[frame]}`];
    if (content.omega.length) facts.push(`omega ${content.omega[frame].toFixed(2)}`);
    if (content.weights.length) facts.push(`weight ${content.weights[frame].toFixed(2)}`);
    one("frame").textContent = facts.join(", ");
    showAngles();
    changed();
  }
  function play(on) {
    state.playing = on;
    clearTimeout(timer);
    one("play").textContent = on ? "Pause" : "Play";
    const show = () => {
      const next = () => { setFrame((state.frame + 1) % frames); show(); };
      timer = setTimeout(next, 1000 * content.shown[state.frame]);
    };
    if (on) show();
  }
  if (frames) {
    one("time").max = frames - 1;
    one("play").addEventListener("click", () => { state.camera = null; play(!state.playing); });
    one("time").addEventListener("input", () => { play(false); setFrame(+one("time").value); });
    const bars = one("bars"), values = content.omega.map(Math.abs);
    if (!values.length) bars.closest("figure").hidden = true;
    values.forEach((value, i) => {
      const bar = bars.appendChild(document.createElementNS("http://www.w3.org/2000/svg", "rect"));
      const high = Math.max(0.01, value) * 40;
      const place = { x: i * (240 / frames), y: 40 - high, width: 240 / frames, height: high };
      for (const [key, number] of Object.entries(place)) bar.setAttribute(key, number);
    });
  } else one("motion").hidden = true;

  // Orbit: one pointer turns, two pinch, the wheel and + - zoom, arrow keys turn, 0 resets.
  const pointers = new Map();
  function turn(dx, dy) {
    state.camera = null;
    eye.yaw += dx;
    eye.pitch = Math.min(Math.max(eye.pitch - dy, -1.55), 1.55);
    changed();
  }
  function zoom(factor) {
    state.camera = null;
    eye.distance = Math.min(Math.max(eye.distance * factor, radius * 1.5), radius * 30);
    changed();
  }
  const spread = () => {
    const [a, b] = [...pointers.values()];
    return Math.hypot(a.x - b.x, a.y - b.y);
  };
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
  });
  canvas.addEventListener("pointermove", (event) => {
    const last = pointers.get(event.pointerId);
    if (!last) return;
    const now = { x: event.clientX, y: event.clientY };
    const before = pointers.size === 2 ? spread() : 0;
    pointers.set(event.pointerId, now);
    if (pointers.size === 2) zoom(before / Math.max(spread(), 1));
    else turn((now.x - last.x) * 0.01, (now.y - last.y) * 0.01);
  });
  for (const kind of ["pointerup", "pointercancel"])
    canvas.addEventListener(kind, (event) => pointers.delete(event.pointerId));
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    zoom(Math.exp(event.deltaY * 0.001));
  }, { passive: false });
  canvas.addEventListener("keydown", (event) => {
    const keys = {
      ArrowLeft: () => turn(-0.1, 0), ArrowRight: () => turn(0.1, 0),
      ArrowUp: () => turn(0, -0.1), ArrowDown: () => turn(0, 0.1),
      "+": () => zoom(0.9), "=": () => zoom(0.9), "-": () => zoom(1.1),
      0: () => { state.camera = null; fit(); changed(); },
    };
    if (!keys[event.key]) return;
    event.preventDefault();
    keys[event.key]();
  });
  for (const name of ["relight", "angle", "height", "strength"])
    one(name).addEventListener("input", () => {
      if (name !== "relight") one("relight").checked = true;
      changed();
    });
  const can = { biases: hands.some((h) => h.data.biases), weights: hands.some((h) => h.data.trusted) };
  for (const [kind, there] of Object.entries(can)) {
    const option = one("shown").querySelector(`[value=${kind}]`);
    option.hidden = option.disabled = !there;
  }
  one("showing").hidden = !can.biases && !can.weights;
  function setShown(kind) {
    one("shown").value = kind;
    one("biased").hidden = kind !== "biases";
    one("weighed").hidden = kind !== "weights";
    changed();
  }
  one("shown").addEventListener("input", () => setShown(one("shown").value));
  one("visibility").hidden = !hands.some((hand) => hand.data.seen);
  one("unseen").addEventListener("input", () => changed());
  function setBackground(color) {
    one("background").value = color;
    state.soft = false;
    changed();
  }
  one("background").addEventListener("input", () => setBackground(one("background").value));
  new ResizeObserver(() => changed()).observe(canvas);
  canvas.addEventListener("webglcontextlost", () => fallback("The browser took WebGL2 away."));

  if (matchMedia("(prefers-color-scheme: dark)").matches) one("background").value = "#2a3036";
  // A picture of what is seen, to send where the browser can, else as a file.
  one("share").addEventListener("click", () => {
    draw();
    canvas.toBlob(async (blob) => {
      const file = new File([blob], "hand.png", { type: "image/png" });
      if (navigator.canShare && navigator.canShare({ files: [file] })) {
        await navigator.share({ files: [file], title: document.title }).catch(() => {});
        return;
      }
      const link = document.createElement("a");
      Object.assign(link, { href: URL.createObjectURL(blob), download: "hand.png" });
      link.click();
      setTimeout(() => URL.revokeObjectURL(link.href), 1000);
    }, "image/png");
  });
  state.dirty = false;
  fit();
  showAngles();
  changed();
  for (const kind of ["pointerdown", "keydown", "wheel", "input"])
    document.addEventListener(kind, rest, { capture: true, passive: true });
  if (!matchMedia("(prefers-reduced-motion: reduce)").matches)
    state.turning = requestAnimationFrame((now) => spin(now, now));
  const actions = {
    // {side: [pose (16, 3) rad, transl (3) m]}.
    setPose, setFrame, setNamed, setShown, setBackground,
    // viewmat (4, 4), K (3, 3), px; the canvas gets this size until the view is turned.
    setCamera(viewmat, K, width, height) {
      const turn = viewmat.slice(0, 3).flatMap((row) => row.slice(0, 3));
      const shift = viewmat.slice(0, 3).map((row) => row[3]);
      state.camera = { turn, shift, lens: [K[0][0], K[1][1], K[0][2], K[1][2]], width, height };
      changed();
    },
    orbit(yaw, pitch) {
      Object.assign(eye, { yaw, pitch });
      state.camera = null;
      changed();
    },
    pixels() { draw(); return splats.pixels(); },
  };
  window.avatar = Object.fromEntries(Object.entries(actions).map(([name, act]) =>
    [name, (...given) => { rest(); return act(...given); }]));
}
function fallback(reason) {
  document.body.classList.add("still");
  one("reason").textContent = `${reason} This is a picture of the hand.`;
}
try { start(); } catch (error) { fallback(`${error.message}.`); }
