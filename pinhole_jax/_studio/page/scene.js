// What is drawn on the graphics card: the mesh, shaded, seen by the same camera (principal point,
// aspect and distortion as they are), and lines over it. One canvas holds both: each canvas more is
// blended over all of the page at each update, which is what costs where no card helps.
"use strict";

const MESH_VERTEX = `#version 300 es
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
const MESH_FRAGMENT = `#version 300 es
precision highp float;
in vec3 at;
uniform float opacity;
out vec4 colour;
void main() {
  vec3 n = normalize(cross(dFdx(at), dFdy(at)));
  float light = 0.3 + 0.6 * abs(dot(n, normalize(at))) + 0.1 * abs(n.y);
  colour = vec4(vec3(0.96, 0.95, 0.92) * light, 1.0) * opacity;
}`;
// A line from a to b is a rectangle with room for its round ends; how far a pixel is from the line
// says how much of it is covered.
const LINE_VERTEX = `#version 300 es
in vec4 ends;
in float half_px;
uniform vec3 zoom; // photo px to px of the canvas: factor and shifts
uniform vec2 size;
out vec2 at;
flat out vec2 length_half;
void main() {
  vec2 a = zoom.x * ends.xy + zoom.yz, b = zoom.x * ends.zw + zoom.yz, d = b - a;
  float l = length(d), room = half_px + 1.0;
  vec2 along = l > 0.0 ? d / l : vec2(1.0, 0.0), across = vec2(-along.y, along.x);
  int corner = gl_VertexID % 6; // of two triangles: 0 1 2, 2 1 3
  corner = corner < 3 ? corner : corner == 3 ? 2 : corner == 4 ? 1 : 3;
  at = vec2(corner < 2 ? -room : l + room, (corner & 1) == 0 ? -room : room);
  length_half = vec2(l, half_px);
  vec2 place = a + at.x * along + at.y * across;
  gl_Position = vec4(2.0 * place.x / size.x - 1.0, 1.0 - 2.0 * place.y / size.y, 0.0, 1.0);
}`;
const LINE_FRAGMENT = `#version 300 es
precision highp float;
in vec2 at;
flat in vec2 length_half;
uniform vec4 tint;
uniform bool once; // where lines overlap, the first covers
out vec4 colour;
void main() {
  float away = length(vec2(at.x - clamp(at.x, 0.0, length_half.x), at.y));
  float covered = clamp(length_half.y + 0.5 - away, 0.0, 1.0);
  if (covered < (once ? 0.5 : 0.002)) discard;
  colour = vec4(tint.rgb, 1.0) * (tint.a * (once ? 1.0 : covered));
}`;
const COEFFICIENTS = ["k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"];

// Return a function that draws what the page shows of a camera, or null without WebGL 2.
function makeScene(canvas, data) {
  const gl = canvas.getContext("webgl2", { antialias: false }); // (the outline is drawn over its edge)
  if (!gl) return null;
  const mesh = makeMesh(gl, data), lines = makeLines(gl);
  return ({ camera, opacity, strokes, zoom, ratio }) => {
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    if (opacity > 0) mesh(camera, opacity, zoom, canvas.width / ratio, canvas.height / ratio);
    for (const stroke of strokes) lines(stroke, zoom, ratio);
  };
}

function makeProgram(gl, vertex, fragment) {
  const program = gl.createProgram();
  for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  const found = {};
  return { program, at: (name) => (found[name] ??= gl.getUniformLocation(program, name)) };
}

function makeMesh(gl, data) {
  const centre = new Float64Array(data, 0, 3), [points, faces] = new Uint32Array(data, 24, 2);
  const { program, at } = makeProgram(gl, MESH_VERTEX, MESH_FRAGMENT);
  const corners = new Float32Array(data, 32, 3 * points), own = gl.createVertexArray();
  gl.bindVertexArray(own);
  gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ARRAY_BUFFER, corners, gl.STATIC_DRAW);
  const position = gl.getAttribLocation(program, "position");
  gl.enableVertexAttribArray(position);
  gl.vertexAttribPointer(position, 3, gl.FLOAT, false, 0, 0);
  gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, new Uint32Array(data, 32 + 12 * points, 3 * faces), gl.STATIC_DRAW);
  let radius = 1e-12;
  for (let k = 0; k < corners.length; k += 3) {
    radius = Math.max(radius, Math.hypot(corners[k], corners[k + 1], corners[k + 2]));
  }
  return (c, opacity, { scale, x, y }, w, h) => {
    const eye = c.eye.map((value, k) => value - centre[k]), far = Math.hypot(...eye);
    gl.useProgram(program);
    gl.bindVertexArray(own);
    gl.enable(gl.DEPTH_TEST);
    gl.disable(gl.BLEND);
    gl.uniform1f(at("opacity"), opacity);
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

// Lines are { paths: [[x, y, x, y, ...], ...], colour: [r, g, b, a], width } in px of the screen; or,
// with `half_px` of the photo for each path and `once`, a band that is no darker where it overlaps.
function makeLines(gl) {
  const { program, at } = makeProgram(gl, LINE_VERTEX, LINE_FRAGMENT);
  const own = gl.createVertexArray(), buffer = gl.createBuffer();
  gl.bindVertexArray(own);
  gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
  for (const [name, size, offset] of [["ends", 4, 0], ["half_px", 1, 16]]) {
    const where = gl.getAttribLocation(program, name);
    gl.enableVertexAttribArray(where);
    gl.vertexAttribPointer(where, size, gl.FLOAT, false, 20, offset);
  }
  return ({ paths, colour, width, half_px, once = false }, { scale, x, y }, ratio) => {
    // Each line is six vertices with the same numbers: a processor that stands in for a card draws
    // instances one by one, at three times the cost.
    const count = 6 * paths.reduce((sum, path) => sum + Math.max(path.length / 2 - 1, 0), 0);
    const rows = new Float32Array(5 * count);
    let next = 0;
    paths.forEach((path, number) => {
      const half = (ratio * Math.max(half_px ? 2 * scale * half_px[number] : 0, width)) / 2;
      for (let k = 0; k + 3 < path.length; k += 2) {
        rows.set([path[k], path[k + 1], path[k + 2], path[k + 3], half], next);
        for (let copy = 1; copy < 6; copy++) rows.copyWithin(next + 5 * copy, next, next + 5);
        next += 30;
      }
    });
    gl.useProgram(program);
    gl.bindVertexArray(own);
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
    gl.bufferData(gl.ARRAY_BUFFER, rows, gl.STREAM_DRAW);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    if (once) {
      gl.clear(gl.DEPTH_BUFFER_BIT);
      gl.enable(gl.DEPTH_TEST);
    } else gl.disable(gl.DEPTH_TEST);
    gl.uniform3f(at("zoom"), ratio * scale, ratio * x, ratio * y);
    gl.uniform2f(at("size"), gl.canvas.width, gl.canvas.height);
    gl.uniform4fv(at("tint"), colour);
    gl.uniform1i(at("once"), once ? 1 : 0);
    gl.drawArrays(gl.TRIANGLES, 0, count);
  };
}
