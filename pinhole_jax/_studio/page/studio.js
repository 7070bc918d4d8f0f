// The page of `pinhole-jax studio`. The camera is the server's: the page asks it to turn, draw and
// fit, and shows what it answers. Places are in px of the photo from its upper left corner, y down.
"use strict";

const $ = (id) => document.getElementById(id);
const token = new URLSearchParams(location.search).get("token");
const TOOLS = {
  turn: "Drag to turn, Shift-drag to shift, Alt-drag to roll, wheel to come nearer; Ctrl-wheel zooms the photo",
  object: "Draw on the object: a few strokes are enough. The wheel zooms, right-drag moves the photo, [ and ] set the brush",
  background: "Draw on the background where the mask is too large",
  add: "Paint onto the mask, exactly",
  erase: "Erase from the mask, exactly",
  line: "Drag along an edge that is straight in space; move k1 in Lens until the line lies on it",
};
const KEYS = { t: "turn", o: "object", b: "background", a: "add", e: "erase", l: "line" };
const FREE = {
  position: "Position", orientation: "Orientation", phi: "Field of view",
  principal_point: "Principal point", k1: "k1", k2: "k2", aspect: "Pixel aspect",
};
const COLOURS = { object: "#4ade80", background: "#fb7185", add: "#4ade80", erase: "#fb7185", line: "#ffd54a" };
// (As a card takes them: red, green, blue and opacity, 0 to 1.)
const CYAN = [0, 0.94, 1, 1], DARK = [0, 0.12, 0.24, 1], YELLOW = [1, 0.86, 0, 0.45];
const WHITE = [1, 1, 1, 0.5], FAINT = [1, 1, 1, 0.33], STRAIGHT = [1, 0.84, 0.3, 1];

const studio = { ready: false, tool: "turn", view: null, fit: null, mask: null, shown: 0, stops: 0, busy: 0 };
window.studio = studio; // what tests look at
let socket, tab = sessionStorage.getItem("tab") || "", next = 1;
let W = 1, H = 1, photo = null, maskImage = null, scene = null;
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
    for (const { reject } of waiting.values()) reject(new Error("the server has stopped"));
    waiting.clear();
    complain("The server has stopped. Start it again, and open the address that it prints.", true);
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
  $("files").textContent = `${answer.mesh} over ${answer.photo}, ${W} × ${H} px`;
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
  scene = makeScene($("scene"), mesh);
  if (!scene) complain("This browser has no WebGL 2: it shows the outline, but not the mesh.");
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

let drawn = false, below = null, above = null;
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
  $("assumed").hidden = !view.phi_is_assumed;
  for (const button of document.querySelectorAll("[data-up]")) button.classList.toggle("on", button.dataset.up === view.upright);
  set("k1", c.distortion.k1 || 0);
  set("k2", c.distortion.k2 || 0);
  set("principal_x", c.principal[0]);
  set("principal_y", c.principal[1]);
  draw();
}

function set(id, value) {
  $(id).value = value;
  label(id, value);
}

function word(id, value) {
  if (id === "phi") return `${value.toFixed(1)}°`;
  if (id === "k1" || id === "k2") return value.toFixed(3);
  if (id === "opacity") return `${Math.round(100 * value)} %`;
  return `${Math.round(value)} px`;
}

function label(id, value) {
  const words = word(id, value), output = $(id).nextElementSibling;
  // (A browser draws the panel anew for words that are set, even to what they are.)
  if (output.textContent !== words) output.textContent = words;
}

function labels() {
  for (const id of ["opacity", "brush"]) label(id, Number($(id).value));
}

function drawAll() {
  const stage = $("stage"), ratio = devicePixelRatio || 1;
  const [w, h] = [stage.clientWidth, stage.clientHeight];
  for (const id of ["under", "over"]) resize($(id), Math.round(w * ratio), Math.round(h * ratio));
  if (!zoom.own) whole();
  const place = (context) => {
    context.setTransform(1, 0, 0, 1, 0, 0);
    context.clearRect(0, 0, w * ratio, h * ratio);
    context.setTransform(ratio * zoom.scale, 0, 0, ratio * zoom.scale, ratio * zoom.x, ratio * zoom.y);
  };
  const tint = !$("show-mask").checked ? 0 : paints() ? 1 : 0.4;
  const shown = [w, h, ratio, zoom.scale, zoom.x, zoom.y, photo, maskImage, tint];
  if (!below || shown.some((value, k) => value !== below[k])) drawUnder(place, shown);
  const view = studio.view, strokes = strokesOf(view);
  if (scene && view) {
    const opacity = $("opacity").value * (paints() ? 0.4 : 1);
    scene({ camera: view.camera, opacity, strokes, zoom: laid(view, strokes, ratio), ratio });
  }
  drawOver(place, scene ? [] : strokes);
  if (view !== above) studio.shown += 1;
  above = view;
}

function resize(canvas, width, height) {
  if (canvas.width === width && canvas.height === height) return;
  [canvas.width, canvas.height] = [width, height];
}

// Lay the scene's canvas where the object is, for what it does not cover is not blended anew; return
// the zoom as seen from its corner. Its size goes in steps: another size is another buffer.
const STEP_PX = 128;
function laid(view, strokes, ratio) {
  const canvas = $("scene"), step = (value) => STEP_PX * Math.ceil(value / STEP_PX);
  const [w, h] = [$("under").width, $("under").height];
  let [left, top, right, bottom] = [Infinity, Infinity, -Infinity, -Infinity];
  for (const { paths, width, half_px } of strokes) {
    paths.forEach((path, number) => {
      const room = ratio * (width + zoom.scale * (half_px ? half_px[number] : 0));
      for (let k = 0; k < path.length; k += 2) {
        const x = ratio * (zoom.scale * path[k] + zoom.x), y = ratio * (zoom.scale * path[k + 1] + zoom.y);
        [left, top] = [Math.min(left, x - room), Math.min(top, y - room)];
        [right, bottom] = [Math.max(right, x + room), Math.max(bottom, y + room)];
      }
    });
  }
  const inside = left >= 0 && top >= 0 && right <= w && bottom <= h;
  const [x, y] = inside ? [Math.floor(left), Math.floor(top)] : [0, 0];
  resize(canvas, inside ? step(right - x) : w, inside ? step(bottom - y) : h);
  canvas.style.cssText = `width:${canvas.width / ratio}px;height:${canvas.height / ratio}px;`
    + `transform:translate(${x / ratio}px,${y / ratio}px)`;
  return { scale: zoom.scale, x: zoom.x - x / ratio, y: zoom.y - y / ratio };
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
  paint(under, { paths: [[0, 0, W, 0, W, H, 0, H, 0, 0]], colour: FAINT, width: 1 });
}

// What is drawn of a view, from below; widths in px of the screen.
function strokesOf(view) {
  if (!view) return [];
  const flat = (lines) => lines.map((line) => line.flat());
  const strokes = [
    { paths: flat(view.grid), colour: WHITE, width: 1 },
    { paths: flat(view.lines), colour: STRAIGHT, width: 2 },
  ];
  const band = view.settles ? rest : view.is_fit && studio.fit && studio.fit.band;
  if (band) strokes.push({ paths: band.lines, half_px: band.half_px, colour: YELLOW, width: 1, once: true });
  strokes.push({ paths: view.outline, colour: DARK, width: 4 }, { paths: view.outline, colour: CYAN, width: 2 });
  return strokes;
}

function drawOver(place, strokes) {
  // What the pointer draws, and without WebGL all else. It is hidden where there is nothing on it:
  // a browser blends even an empty canvas.
  const guides = $("show-mask").checked && studio.mask && paints() ? studio.mask.guides : [];
  const points = pointer && COLOURS[studio.tool] && studio.tool !== "line" && !drag;
  $("over").hidden = !(strokes.length || guides.length || stroke || points);
  if ($("over").hidden) return;
  const over = $("over").getContext("2d");
  place(over);
  over.lineCap = over.lineJoin = "round";
  for (const each of strokes) paint(over, each);
  for (const guide of guides) drawStroke(over, guide, "66");
  if (stroke) drawStroke(over, stroke, "aa");
  if (points) {
    over.strokeStyle = COLOURS[studio.tool];
    over.lineWidth = 1.5 / zoom.scale;
    over.beginPath();
    over.arc(...pointer, brush(), 0, 2 * Math.PI);
    over.stroke();
  }
}

function drawStroke(context, { kind, radius_px, points }, alpha) {
  context.strokeStyle = COLOURS[kind] + alpha;
  context.lineWidth = 2 * radius_px;
  context.beginPath();
  context.moveTo(...points[0]);
  for (const point of points.length > 1 ? points : [points[0]]) context.lineTo(...point);
  context.stroke();
}

// (As scene.js draws lines, where there is no WebGL.)
function paint(context, { paths, colour: [r, g, b, a], width, half_px }) {
  context.strokeStyle = `rgb(${255 * r} ${255 * g} ${255 * b} / ${a})`;
  paths.forEach((path, number) => {
    context.lineWidth = Math.max(half_px ? 2 * half_px[number] : 0, width / zoom.scale);
    context.beginPath();
    for (let k = 0; k < path.length; k += 2) context.lineTo(path[k], path[k + 1]);
    context.stroke();
  });
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
  $("unfitted").hidden = !!fit;
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
  const band = fit.band;
  $("band").textContent = band && band.median_px
    ? `Yellow: the outline's one-sigma band; one sigma is ${band.median_px.toPrecision(2)} px (median).` : "";
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
  if (!free().length) return complain("Tick at least one parameter that the fit may change.");
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
    const view = await act("one moment", "move", now);
    if (view) show(view);
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
    // (The first that bends the picture compiles: seconds.)
    const view = await act("one moment", "lens", now);
    if (view) show(view);
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
  $("hand").style.cursor = name === "turn" ? "grab" : name === "line" ? "crosshair" : "none";
  $("hint").textContent = TOOLS[name];
  draw();
}

function whole() {
  const [w, h] = [$("stage").clientWidth, $("stage").clientHeight], room = 12;
  const scale = Math.max(Math.min((w - 2 * room) / W, (h - 2 * room) / H), 1e-3);
  zoom = { scale, x: (w - scale * W) / 2, y: (h - scale * H) / 2, own: false };
}

$("hand").addEventListener("pointerdown", (event) => {
  event.preventDefault();
  $("stage").focus();
  $("hand").setPointerCapture(event.pointerId);
  drag = { x: event.clientX, y: event.clientY, button: event.button };
  if (studio.tool === "turn" || event.button !== 0) {
    $("hand").style.cursor = "grabbing";
    return;
  }
  stroke = { kind: studio.tool, radius_px: studio.tool === "line" ? 1 / zoom.scale : brush(), points: [place(event)] };
  draw();
});

$("hand").addEventListener("pointermove", (event) => {
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
  const answer = await act("one moment", "stroke", done);
  await showMask(answer);
}
$("hand").addEventListener("pointerup", released);
$("hand").addEventListener("pointercancel", released);
$("hand").addEventListener("pointerleave", () => { pointer = null; draw(); });
$("hand").addEventListener("contextmenu", (event) => event.preventDefault());

$("hand").addEventListener("wheel", (event) => {
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
