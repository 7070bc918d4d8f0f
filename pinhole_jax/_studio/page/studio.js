// The page of `pinhole-jax studio`. The camera is the server's: the page asks it to turn, draw and
// fit, and shows what it answers. Places are in px of the photo from its upper left corner, y down.
"use strict";

const $ = (id) => document.getElementById(id);
const token = new URLSearchParams(location.search).get("token");
const TOOLS = {
  turn: "Drag to turn, Shift-drag to shift, Alt-drag to roll, wheel to come nearer; Ctrl-wheel zooms the photo",
  object: "Draw on the object: a few strokes are enough. Wheel zooms, right-drag moves the photo, [ and ] set the brush",
  background: "Draw on the background where the mask is too large",
  add: "Paint onto the mask, exactly",
  erase: "Take off the mask, exactly",
  line: "Drag along an edge that is straight in space; move k1 in Lens until the line lies on it",
};
const KEYS = { t: "turn", o: "object", b: "background", a: "add", e: "erase", l: "line" };
const FREE = {
  position: "Position", orientation: "Orientation", phi: "Field of view",
  principal_point: "Principal point", k1: "k1", k2: "k2", aspect: "Pixel aspect",
};
const COLOURS = { object: "#4ade80", background: "#fb7185", add: "#4ade80", erase: "#fb7185", line: "#ffd54a" };
const CYAN = "#00f0ff", DARK = "#001e3c", YELLOW = "255, 220, 0";

const studio = { ready: false, tool: "turn", view: null, fit: null, mask: null, updates: 0, stops: 0, busy: 0 };
window.studio = studio; // what tests look at
let socket, tab = sessionStorage.getItem("tab") || "", next = 1;
let W = 1, H = 1, photo = null, maskImage = null, solid = null;
let zoom = { scale: 1, x: 0, y: 0, own: false };
let stroke = null, drag = null, pointer = null;
const waiting = new Map();

// Talking with the server.

function ask(name, numbers = {}) {
  return new Promise((resolve, reject) => {
    waiting.set(next, { resolve, reject });
    socket.send(JSON.stringify({ id: next++, do: name, ...numbers }));
  });
}

async function act(words, name, numbers) {
  // Ask for what takes a while, and say so; null where it cannot be.
  studio.busy += 1;
  $("error").hidden = true;
  showBusy(words);
  try {
    return await ask(name, numbers);
  } catch (error) {
    complain(error.message);
    return null;
  } finally {
    studio.busy -= 1;
    if (!studio.busy) $("busy").hidden = true;
  }
}

function connect() {
  socket = new WebSocket(`ws://${location.host}/bench?token=${token}&tab=${tab}`);
  socket.onmessage = ({ data }) => heard(JSON.parse(data));
  socket.onclose = () => {
    for (const { reject } of waiting.values()) reject(new Error("the server is gone"));
    waiting.clear();
    complain("The server is gone. Start it again, and open the address that it prints.", true);
  };
}

function heard(message) {
  if (message.push === "tab") {
    tab = message.tab;
    sessionStorage.setItem("tab", tab);
    ask("hello").then(opened, (error) => complain(error.message));
  } else if (message.push === "progress") {
    showBusy(message.words);
    settling.push(message);
  } else {
    const { resolve, reject } = waiting.get(message.id);
    waiting.delete(message.id);
    if ("error" in message) reject(new Error(message.error));
    else resolve(message.answer);
  }
}

function complain(words, stay = false) {
  $("error").textContent = words;
  $("error").hidden = false;
  clearTimeout(complain.timer);
  if (!stay) complain.timer = setTimeout(() => { $("error").hidden = true; }, 7000);
}

function showBusy(words) {
  $("busy-words").textContent = words;
  clearTimeout(showBusy.timer);
  showBusy.timer = setTimeout(() => { $("busy").hidden = !studio.busy; }, 150);
}

// What a fit passes on its way is shown one after another, so that an eye can follow.
// The band is the one it comes to rest in, as soon as that is known.
const settling = [], STOP_MS = 45, MOST_STOPS = 60;
let rest = null;
setInterval(() => {
  const stop = settling.shift();
  if (!stop) return;
  studio.stops += 1;
  show({ ...studio.view, ...stop, is_fit: false, settles: true });
}, STOP_MS);
const settled = () => new Promise((resolve) => {
  const timer = setInterval(() => { if (!settling.length) { clearInterval(timer); resolve(); } }, 30);
});

// Opening.

async function opened(answer) {
  [W, H] = [answer.W, answer.H];
  $("files").textContent = `${answer.mesh} before ${answer.photo}, ${W} × ${H} px`;
  document.title = `${answer.photo} – pinhole_jax studio`;
  fillFree(answer.free);
  $("format").replaceChildren(...["all", ...answer.formats].map((name) => new Option(name)));
  $("name").value = answer.photo.replace(/\.[^.]*$/, "").replace(/[^\p{L}\p{N}_-]/gu, "_") || "camera";
  for (const [id, size] of [["principal_x", W], ["principal_y", H]]) {
    Object.assign($(id), { min: 0.3 * size, max: 0.7 * size });
  }
  $("brush").max = Math.ceil(Math.max(W, H) / 10);
  $("brush").value = Math.max(2, Math.round(Math.max(W, H) / 75));
  const query = `token=${token}&tab=${tab}`;
  const [picture, mesh] = await Promise.all([
    load(`photo?${query}`), fetch(`mesh?${query}`).then((r) => r.arrayBuffer()),
  ]);
  photo = picture;
  solid = makeSolid($("solid"), mesh);
  if (!solid) complain("This browser has no WebGL 2: the outline is shown, the mesh is not.");
  if (!zoom.own) whole();
  await showMask(answer.mask);
  show(answer.view);
  showFit(answer.fit);
  tool(studio.tool);
  labels();
  studio.ready = true;
}

function load(address) {
  return new Promise((resolve, reject) => {
    const image = new Image();
    image.onload = () => resolve(image);
    image.onerror = () => reject(new Error("the photo cannot be shown"));
    image.src = address;
  });
}

function fillFree(chosen) {
  const on = new Set(chosen.flatMap((n) => (n === "pose" ? ["position", "orientation"] : [n])));
  const boxes = Object.entries(FREE).map(([name, words]) => {
    const label = document.createElement("label"), box = document.createElement("input");
    Object.assign(box, { type: "checkbox", checked: on.has(name), value: name });
    label.append(box, ` ${words}`);
    return label;
  });
  $("free").replaceChildren(...boxes);
}

const free = () => [...$("free").querySelectorAll("input:checked")].map((box) => box.value);

// Showing.

let drawn = false, below = null;
function draw() {
  if (drawn) return;
  drawn = true;
  requestAnimationFrame(() => { drawn = false; drawAll(); });
}

const paints = () => studio.tool !== "turn" && studio.tool !== "line";

function show(view) {
  studio.view = view;
  const c = view.camera;
  set("phi", c.phi_degrees);
  set("k1", c.distortion.k1 || 0);
  set("k2", c.distortion.k2 || 0);
  set("principal_x", c.principal[0]);
  set("principal_y", c.principal[1]);
  draw();
}

function set(id, value) {
  if (document.activeElement !== $(id) || !drag) $(id).value = value;
  $(id).nextElementSibling.textContent = word(id, value);
}

function word(id, value) {
  if (id === "phi") return `${value.toFixed(1)}°`;
  if (id === "k1" || id === "k2") return value.toFixed(3);
  if (id === "opacity") return `${Math.round(100 * value)} %`;
  return `${Math.round(value)} px`;
}

function labels() {
  for (const id of ["opacity", "brush"]) $(id).nextElementSibling.textContent = word(id, Number($(id).value));
}

function drawAll() {
  const stage = $("stage"), ratio = devicePixelRatio || 1;
  const [w, h] = [stage.clientWidth, stage.clientHeight];
  for (const id of ["under", "solid", "over"]) {
    const canvas = $(id);
    if (canvas.width !== Math.round(w * ratio) || canvas.height !== Math.round(h * ratio)) {
      [canvas.width, canvas.height] = [Math.round(w * ratio), Math.round(h * ratio)];
    }
  }
  if (!zoom.own) whole();
  const place = (context) => {
    context.setTransform(1, 0, 0, 1, 0, 0);
    context.clearRect(0, 0, w * ratio, h * ratio);
    context.setTransform(ratio * zoom.scale, 0, 0, ratio * zoom.scale, ratio * zoom.x, ratio * zoom.y);
  };
  const tint = !$("show-mask").checked ? 0 : paints() ? 1 : 0.4;
  const shown = [w, h, ratio, zoom.scale, zoom.x, zoom.y, photo, maskImage, tint];
  if (!below || shown.some((value, k) => value !== below[k])) drawUnder(place, shown);
  $("solid").style.opacity = $("opacity").value * (paints() ? 0.4 : 1);
  if (solid && studio.view) solid(studio.view.camera, zoom, w, h);
  const over = $("over").getContext("2d");
  place(over);
  drawOver(over);
}

function drawUnder(place, shown) {
  // Photo and mask are drawn when they change, not each time that the mesh is turned.
  below = shown;
  const under = $("under").getContext("2d");
  place(under);
  under.imageSmoothingEnabled = zoom.scale < 4;
  if (photo) under.drawImage(photo, 0, 0, W, H);
  under.globalAlpha = shown.at(-1);
  if (maskImage) under.drawImage(maskImage, 0, 0);
  under.globalAlpha = 1;
}

function drawOver(over) {
  const px = 1 / zoom.scale, view = studio.view;
  over.lineCap = over.lineJoin = "round";
  over.strokeStyle = "#ffffff55";
  over.lineWidth = px;
  over.strokeRect(0, 0, W, H);
  if ($("show-mask").checked && studio.mask && paints()) {
    for (const guide of studio.mask.guides) drawStroke(over, guide, "66");
  }
  if (view) {
    trace(over, view.grid, "#ffffff80", px);
    trace(over, view.lines, COLOURS.line, 2 * px);
    const band = view.settles ? rest : view.is_fit && studio.fit && studio.fit.band;
    if (band) drawBand(over, band, px);
    paths(over, view.outline, DARK, 4 * px);
    paths(over, view.outline, CYAN, 2 * px);
  }
  if (stroke) drawStroke(over, stroke, "aa");
  if (pointer && COLOURS[studio.tool] && studio.tool !== "line" && !drag) {
    over.strokeStyle = COLOURS[studio.tool];
    over.lineWidth = 1.5 * px;
    over.beginPath();
    over.arc(...pointer, brush(), 0, 2 * Math.PI);
    over.stroke();
  }
}

function drawStroke(context, { kind, radius, points }, alpha) {
  context.strokeStyle = COLOURS[kind] + alpha;
  context.lineWidth = 2 * radius;
  context.beginPath();
  context.moveTo(...points[0]);
  for (const point of points.length > 1 ? points : [points[0]]) context.lineTo(...point);
  context.stroke();
}

function trace(context, lines, colour, width) {
  context.strokeStyle = colour;
  context.lineWidth = width;
  context.beginPath();
  for (const line of lines) line.forEach(([x, y], k) => (k ? context.lineTo(x, y) : context.moveTo(x, y)));
  context.stroke();
}

function paths(context, lines, colour, width) {
  context.strokeStyle = colour;
  context.lineWidth = width;
  context.beginPath();
  for (const line of lines) {
    context.moveTo(line[0], line[1]);
    for (let k = 2; k < line.length; k += 2) context.lineTo(line[k], line[k + 1]);
  }
  context.stroke();
}

const veil = document.createElement("canvas");
function drawBand(over, band, px) {
  // Drawn opaque on a canvas of its own, so that where its parts overlap it is no darker.
  const { width, height } = over.canvas, context = veil.getContext("2d");
  [veil.width, veil.height] = [width, height];
  context.setTransform(over.getTransform());
  context.lineCap = "round";
  context.strokeStyle = `rgb(${YELLOW})`;
  band.lines.forEach(([a, b, c, d], k) => {
    context.lineWidth = Math.max(2 * band.half_px[k], px);
    context.beginPath();
    context.moveTo(a, b);
    context.lineTo(c, d);
    context.stroke();
  });
  over.save();
  over.setTransform(1, 0, 0, 1, 0, 0);
  over.globalAlpha = 0.45;
  over.drawImage(veil, 0, 0);
  over.restore();
}

// The mesh, shaded, seen by the same camera: principal point, aspect and distortion as they are.

const VERTEX = `#version 300 es
in vec3 position;
out vec3 at;
uniform mat3 axes;
uniform vec3 eye;
uniform vec2 focal, principal, depth;
uniform vec4 window; // film px to clip space: factors and shifts
uniform float k[8];
uniform int model; // 0 none, 1 Brown-Conrady and rational, 2 fisheye
void main() {
  at = axes * (position - eye);
  vec2 n = at.xy;
  float z = at.z;
  if (model > 0 && z > 1e-4 * depth.y) {
    n /= z;
    float s = dot(n, n);
    if (model == 1) {
      float radial = (1.0 + s * (k[0] + s * (k[1] + s * k[4]))) / (1.0 + s * (k[5] + s * (k[6] + s * k[7])));
      n = n * radial + vec2(-2.0 * k[2] * n.x * n.y + k[3] * (s + 2.0 * n.x * n.x),
                            -k[2] * (s + 2.0 * n.y * n.y) + 2.0 * k[3] * n.x * n.y);
    } else {
      float r = sqrt(s), t = atan(r), u = t * t;
      n *= r > 1e-6 ? t * (1.0 + u * (k[0] + u * (k[1] + u * (k[2] + u * k[3])))) / r : 1.0;
    }
    n *= z;
  }
  vec2 film = focal * n + principal * z;
  float near = depth.x, far = depth.y;
  gl_Position = vec4(window.xy * film + window.zw * z, ((far + near) * z - 2.0 * far * near) / (far - near), z);
}`;
const FRAGMENT = `#version 300 es
precision highp float;
in vec3 at;
out vec4 colour;
void main() {
  vec3 n = normalize(cross(dFdx(at), dFdy(at)));
  float light = 0.3 + 0.6 * abs(dot(n, normalize(at))) + 0.1 * abs(n.y);
  colour = vec4(vec3(0.96, 0.95, 0.92) * light, 1.0);
}`;
const COEFFICIENTS = ["k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"];

function makeSolid(canvas, data) {
  const gl = canvas.getContext("webgl2", { antialias: false });  // (the outline is drawn over its edge)
  if (!gl) return null;
  const centre = new Float64Array(data, 0, 3), [points, faces] = new Uint32Array(data, 24, 2);
  const program = gl.createProgram();
  for (const [kind, source] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  gl.useProgram(program);
  gl.bindVertexArray(gl.createVertexArray());
  gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ARRAY_BUFFER, new Float32Array(data, 32, 3 * points), gl.STATIC_DRAW);
  const position = gl.getAttribLocation(program, "position");
  gl.enableVertexAttribArray(position);
  gl.vertexAttribPointer(position, 3, gl.FLOAT, false, 0, 0);
  gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, new Uint32Array(data, 32 + 12 * points, 3 * faces), gl.STATIC_DRAW);
  gl.enable(gl.DEPTH_TEST);
  const corners = new Float32Array(data, 32, 3 * points);
  let radius = 1e-12;
  for (let k = 0; k < corners.length; k += 3) {
    radius = Math.max(radius, Math.hypot(corners[k], corners[k + 1], corners[k + 2]));
  }
  const at = (name) => gl.getUniformLocation(program, name);
  return (c, { scale, x, y }, w, h) => {
    const eye = c.eye.map((value, k) => value - centre[k]), far = Math.hypot(...eye);
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.uniformMatrix3fv(at("axes"), true, c.axes.flat());
    gl.uniform3fv(at("eye"), eye);
    gl.uniform2fv(at("focal"), c.focal);
    gl.uniform2fv(at("principal"), c.principal);
    gl.uniform2f(at("depth"), Math.max(far - 1.05 * radius, 1e-3 * (far + radius)), far + 1.05 * radius);
    gl.uniform4f(at("window"), 2 * scale / w, 2 * scale / h, 2 * x / w - 1, 1 - 2 * (y + scale * c.H) / h);
    const fisheye = c.model === "Fisheye";
    const k = (fisheye ? ["k1", "k2", "k3", "k4", "", "", "", ""] : COEFFICIENTS).map((n) => c.distortion[n] || 0);
    gl.uniform1fv(at("k"), k);
    gl.uniform1i(at("model"), c.model === null ? 0 : fisheye ? 2 : 1);
    gl.drawElements(gl.TRIANGLES, 3 * faces, gl.UNSIGNED_INT, 0);
  };
}

// Mask and fit.

async function showMask(told) {
  if (!told) return;
  studio.mask = told;
  maskImage = null;
  if (told.png) {
    const grey = await load(`data:image/png;base64,${told.png}`);
    const canvas = Object.assign(document.createElement("canvas"), { width: W, height: H });
    const context = canvas.getContext("2d");
    context.drawImage(grey, 0, 0);
    const picture = context.getImageData(0, 0, W, H), values = picture.data;
    for (let k = 0; k < values.length; k += 4) {
      const inside = values[k];
      [values[k], values[k + 1], values[k + 2], values[k + 3]] = [64, 130, 255, 0.5 * inside];
    }
    context.putImageData(picture, 0, 0);
    maskImage = canvas;
  }
  $("share").textContent = told.png ? `${(100 * told.share).toFixed(1)} % of the photo` : "none yet";
  $("undo").disabled = !told.can_undo;
  $("redo").disabled = !told.can_redo;
  $("clear").disabled = !told.png && !told.guides.length;
  $("fit").disabled = $("search").disabled = !told.png;
  draw();
}

function cell(row, kind, words) {
  const made = document.createElement(kind);
  made.textContent = words;
  row.append(made);
}

function list(id, lines) {
  $(id).replaceChildren();
  for (const words of lines) cell($(id), "li", words);
}

function showFit(fit) {
  studio.fit = fit;
  $("result").hidden = !fit;
  if (!fit) return;
  $("status").className = fit.status;
  $("status").innerHTML = "<b></b><span></span>";
  $("status").firstChild.textContent = fit.status;
  const overlap = fit.iou === null ? "" : ` IoU ${fit.iou.toFixed(4)}.`;
  $("status").lastChild.textContent = `${fit.meaning}.${overlap}`;
  const body = $("table").tBodies[0];
  body.replaceChildren();
  for (const [name, value, std, unit, words] of fit.rows) {
    const row = document.createElement("tr");
    row.title = words;
    for (const text of [name, value, std, unit]) cell(row, "td", text);
    body.append(row);
  }
  const band = fit.band, wide = band && band.factor !== 1 ? `, drawn ${band.factor} times as wide` : "";
  $("band").textContent = band && band.median_px
    ? `Yellow: the outline's one-sigma band${wide}; one sigma is ${band.median_px.toPrecision(2)} px (median).` : "";
  list("notes", fit.notes);
  $("pose").textContent = fit.pose;
  $("modes").replaceChildren();
  if (fit.modes.length > 1) {
    fit.modes.forEach((iou, number) => {
      cell($("modes"), "button", `View ${number + 1}: IoU ${iou.toFixed(3)}`);
      const button = $("modes").lastChild;
      button.classList.toggle("on", number === fit.chosen);
      button.onclick = async () => took(await act("one moment", "mode", { number }));
    });
  }
}

function took(answer) {
  if (!answer) return;
  showFit(answer.fit);
  show(answer.view);
}

async function fit(search) {
  if (studio.busy || $("fit").disabled) return;
  if (!free().length) return complain("Free something that the fit may change.");
  $("stop").hidden = false;
  rest = null;
  const answer = await act("fitting (the first time compiles: seconds)", "fit", { free: free(), search, refine: $("refine").checked });
  $("stop").hidden = true;
  rest = answer && answer.fit.band;
  settling.splice(0, Math.max(settling.length - MOST_STOPS, 0)); // (a search passes many)
  await settled();
  took(answer);
  if (!answer) return void ask("look").then(show, () => {});
  $("result").scrollIntoView({ behavior: "smooth", block: "nearest" });
}

// Moving: one question at a time; what happens meanwhile adds up.

let pending = null, asking = false;
async function move(change) {
  pending = pending || { turn: [0, 0, 0], shift: [0, 0], nearer: 1 };
  (change.turn || []).forEach((value, k) => { pending.turn[k] += value; });
  (change.shift || []).forEach((value, k) => { pending.shift[k] += value; });
  pending.nearer *= change.nearer || 1;
  if (asking) return;
  asking = true;
  while (pending) {
    const now = pending;
    pending = null;
    try {
      show(await ask("move", now));
      studio.updates += 1;
    } catch (error) {
      complain(error.message);
    }
  }
  asking = false;
}

let changes = null;
async function change(numbers) {
  const first = changes === null;
  changes = { ...changes, ...numbers };
  if (!first) return;
  while (Object.keys(changes).length) {
    const now = changes;
    changes = {};
    try {
      show(await ask("lens", now));
    } catch (error) {
      complain(error.message);
    }
  }
  changes = null;
}

// The pointer.

const brush = () => Number($("brush").value);
const place = (event) => {
  const box = $("stage").getBoundingClientRect();
  return [(event.clientX - box.left - zoom.x) / zoom.scale, (event.clientY - box.top - zoom.y) / zoom.scale];
};

function tool(name) {
  studio.tool = name;
  for (const button of $("tools").querySelectorAll("button")) {
    button.classList.toggle("on", button.dataset.tool === name);
    button.setAttribute("aria-pressed", button.dataset.tool === name);
  }
  $("over").style.cursor = name === "turn" ? "grab" : name === "line" ? "crosshair" : "none";
  $("hint").textContent = TOOLS[name];
  draw();
}

function whole() {
  const [w, h] = [$("stage").clientWidth, $("stage").clientHeight], room = 12;
  const scale = Math.max(Math.min((w - 2 * room) / W, (h - 2 * room) / H), 1e-3);
  zoom = { scale, x: (w - scale * W) / 2, y: (h - scale * H) / 2, own: false };
}

$("over").addEventListener("pointerdown", (event) => {
  event.preventDefault();
  $("stage").focus();
  $("over").setPointerCapture(event.pointerId);
  drag = { x: event.clientX, y: event.clientY, button: event.button };
  if (studio.tool === "turn" || event.button !== 0) {
    $("over").style.cursor = "grabbing";
    return;
  }
  stroke = { kind: studio.tool, radius: studio.tool === "line" ? 1 / zoom.scale : brush(), points: [place(event)] };
  draw();
});

$("over").addEventListener("pointermove", (event) => {
  pointer = place(event);
  if (!drag) return draw();
  const [dx, dy] = [event.clientX - drag.x, event.clientY - drag.y];
  if (stroke) {
    if (stroke.kind === "line") stroke.points = [stroke.points[0], pointer];
    else stroke.points.push(pointer);
    return draw();
  }
  [drag.x, drag.y] = [event.clientX, event.clientY];
  const size = zoom.scale * Math.min(W, H);
  if (studio.tool !== "turn" || drag.button === 1) {
    zoom = { ...zoom, x: zoom.x + dx, y: zoom.y + dy, own: true };
    draw();
  } else if (event.shiftKey || drag.button === 2) {
    move({ shift: [dx / zoom.scale, dy / zoom.scale] });
  } else if (event.altKey) {
    move({ turn: [0, 0, (Math.PI * dx) / size] });
  } else {
    move({ turn: [(Math.PI * dx) / size, (-Math.PI * dy) / size, 0] });
  }
});

async function released() {
  drag = null;
  tool(studio.tool);
  const done = stroke;
  stroke = null;
  if (!done) return;
  if (done.kind === "line") {
    const [a, b] = done.points;
    if (b && Math.hypot(a[0] - b[0], a[1] - b[1]) > 4 / zoom.scale) straight({ line: [a, b] });
    return;
  }
  const answer = await act("one moment", "stroke", { kind: done.kind, radius_px: done.radius, points: done.points });
  await showMask(answer);
}
$("over").addEventListener("pointerup", released);
$("over").addEventListener("pointercancel", released);
$("over").addEventListener("pointerleave", () => { pointer = null; draw(); });
$("over").addEventListener("contextmenu", (event) => event.preventDefault());

$("over").addEventListener("wheel", (event) => {
  event.preventDefault();
  const factor = Math.exp(Math.max(-60, Math.min(60, event.deltaY)) * 0.002);
  if (studio.tool === "turn" && !event.ctrlKey) return void move({ nearer: factor });
  const box = $("stage").getBoundingClientRect();
  const [x, y] = [event.clientX - box.left, event.clientY - box.top];
  const scale = Math.min(Math.max(zoom.scale / factor, 0.02), 60), ratio = scale / zoom.scale;
  zoom = { scale, x: x - ratio * (x - zoom.x), y: y - ratio * (y - zoom.y), own: true };
  draw();
}, { passive: false });

document.addEventListener("keydown", (event) => {
  if (event.target.matches("#name, select")) return;
  const key = event.key.toLowerCase();
  if (event.ctrlKey || event.metaKey) {
    if (key === "z") $(event.shiftKey ? "redo" : "undo").click();
    else if (key === "y") $("redo").click();
    else return;
    event.preventDefault();
  } else if (KEYS[key]) tool(KEYS[key]);
  else if (key === "f") fit(false);
  else if (key === "0") { zoom.own = false; draw(); }
  else if (key === "[" || key === "]") {
    $("brush").value = brush() * (key === "]" ? 1.25 : 0.8) + (key === "]" ? 0.5 : -0.5);
    labels();
    draw();
  }
});

// The panel.

for (const button of $("tools").querySelectorAll("button")) button.onclick = () => tool(button.dataset.tool);
for (const button of document.querySelectorAll("[data-up]")) {
  button.onclick = async () => {
    const view = await act("one moment", "stand", { up: button.dataset.up });
    if (view) show(view);
  };
}
for (const id of ["opacity", "brush"]) $(id).oninput = () => { labels(); draw(); };
$("phi").oninput = () => change({ phi_degrees: Number($("phi").value) });
for (const id of ["k1", "k2", "principal_x", "principal_y"]) {
  $(id).oninput = () => change({ [id]: Number($(id).value) });
}
async function straight(numbers) {
  const view = await act("one moment", "straight", { grid: $("grid").checked, ...numbers });
  if (view) show(view);
}
$("grid").onchange = () => straight({});
$("no-lines").onclick = () => straight({ clear: true });
$("show-mask").onchange = draw;
for (const [id, name] of [["undo", "undo"], ["redo", "redo"], ["clear", "clear"], ["guess", "view_guides"]]) {
  $(id).onclick = async () => { if (!$(id).disabled) showMask(await act("one moment", name)); };
}
$("load").onclick = () => $("mask-file").click();
$("mask-file").onchange = async () => {
  const [file] = $("mask-file").files;
  if (!file) return;
  const data = await base64(file);
  $("mask-file").value = "";
  showMask(await act("reading the mask", "load_mask", { data, name: file.name }));
};
const base64 = (file) => new Promise((resolve) => {
  const reader = new FileReader();
  reader.onload = () => resolve(reader.result.slice(reader.result.indexOf(",") + 1));
  reader.readAsDataURL(file);
});
$("fit").onclick = () => fit(false);
$("search").onclick = () => fit(true);
$("stop").onclick = () => ask("stop");
$("restore").onclick = async () => {
  const view = await act("one moment", "restore");
  if (view) show(view);
};
$("way").onclick = async () => {
  const answer = await act("one moment", "way");
  if (!answer) return;
  rest = studio.fit.band;
  settling.push(...answer.stops);
  await settled();
  show(await ask("restore"));
};
async function written(name, numbers) {
  const answer = await act("writing", name, numbers);
  if (answer) list("written", answer.written);
}
$("export").onclick = () => written("export", { format: $("format").value, name: $("name").value });
$("save").onclick = () => written("save", { name: $("name").value, free: free() });
$("open").onclick = () => $("session-file").click();
$("session-file").onchange = async () => {
  const [file] = $("session-file").files;
  if (!file) return;
  const text = await file.text();
  $("session-file").value = "";
  const answer = await act("opening the session", "open", { text, name: file.name });
  if (answer) {
    studio.ready = false;
    zoom.own = false;
    opened(answer);
  }
};

new ResizeObserver(draw).observe($("stage"));
connect();
