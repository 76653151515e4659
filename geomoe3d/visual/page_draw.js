"use strict";
/* Two ways to draw the same thing: WebGL 2 where there is a graphics card, a plain canvas elsewhere.
   Matrices are column-major arrays of 16. A frame is
   { model, view, projection, near, far, pixelsPerUnit, clouds: [{ name, model }], classes: [visible], background }. */

function multiply(a, b) {
  const out = new Float64Array(16);
  for (let c = 0; c < 4; c++) for (let r = 0; r < 4; r++) {
    let sum = 0;
    for (let k = 0; k < 4; k++) sum += a[4 * k + r] * b[4 * c + k];
    out[4 * c + r] = sum;
  }
  return out;
}

const POINT_VERTEX = `#version 300 es
in vec3 position; in vec3 color;
uniform mat4 model, view, projection; uniform float size, least;
out vec3 tint;
void main() {
  vec4 seen = view * model * vec4(position, 1.0);
  gl_Position = projection * seen;
  gl_PointSize = clamp(size / -seen.z, least, 48.0);
  tint = color;
}`;
const POINT_FRAGMENT = `#version 300 es
precision highp float;
in vec3 tint; out vec4 pixel;
void main() {
  vec2 off = gl_PointCoord - 0.5;
  if (dot(off, off) > 0.25) discard;
  pixel = vec4(tint, 1.0);
}`;
const WHOLE_VERTEX = `#version 300 es
void main() {
  vec2 corner = vec2(float((gl_VertexID << 1) & 2), float(gl_VertexID & 2));
  gl_Position = vec4(2.0 * corner - 1.0, 0.0, 1.0);
}`;
/* Eye-dome lighting: a pixel is darkened by how far its neighbours stand in front of it. Bare points have
   no normals, so without it a cloud of one colour is a flat blot. Each neighbour counts for a little only:
   far surfaces seen through the gaps of a near one would be black dots otherwise. */
const SHADE_FRAGMENT = `#version 300 es
precision highp float; precision highp sampler2D;
uniform sampler2D colors, depths; uniform vec3 background; uniform float near, far, reach, strength;
out vec4 pixel;
float log_depth(ivec2 at) {
  float d = texelFetch(depths, clamp(at, ivec2(0), textureSize(depths, 0) - 1), 0).r;
  return d >= 1.0 ? -1.0e9 : log2(near * far / (far - d * (far - near)));
}
void main() {
  ivec2 at = ivec2(gl_FragCoord.xy);
  float here = log_depth(at);
  if (here < -1.0e8) { pixel = vec4(background, 1.0); return; }
  float sum = 0.0;
  for (int i = 0; i < 8; i++) {
    float turn = 0.785398 * float(i);
    float there = log_depth(at + ivec2(round(reach * vec2(cos(turn), sin(turn)))));
    if (there > -1.0e8) sum += clamp(here - there, 0.0, 0.03);
  }
  pixel = vec4(texelFetch(colors, at, 0).rgb * (0.25 + 0.75 * exp(-strength * sum)), 1.0);
}`;
const LINE_VERTEX = `#version 300 es
in vec3 position; in vec3 color; in float end;
uniform mat4 model, view, projection;
out vec3 tint;
void main() {
  vec4 placed = end < 0.5 ? model * vec4(position, 1.0) : vec4(position, 1.0);
  gl_Position = projection * view * placed;
  tint = color;
}`;
const LINE_FRAGMENT = `#version 300 es
precision highp float; precision highp sampler2D;
in vec3 tint; out vec4 pixel;
uniform sampler2D depths;
void main() {
  bool hidden = gl_FragCoord.z > texelFetch(depths, ivec2(gl_FragCoord.xy), 0).r;
  pixel = vec4(tint, hidden ? 0.3 : 0.9);
}`;

/** Draws with WebGL 2. clouds: {name: {points, colors}}; lines: {vertices, ends, colors, ranges}. Throws if it cannot. */
class CardRenderer {
  constructor(canvas, clouds, lines) {
    this.kind = "webgl2";
    const gl = canvas.getContext("webgl2", { alpha: false, antialias: false, depth: false, powerPreference: "high-performance" });
    if (!gl) throw new Error("no WebGL 2");
    this.gl = gl;
    this.canvas = canvas;
    this.points = this.program(POINT_VERTEX, POINT_FRAGMENT);
    this.shade = this.program(WHOLE_VERTEX, SHADE_FRAGMENT);
    this.strokes = this.program(LINE_VERTEX, LINE_FRAGMENT);
    this.whole = gl.createVertexArray();
    this.clouds = {};
    for (const [name, cloud] of Object.entries(clouds)) {
      const array = gl.createVertexArray();
      gl.bindVertexArray(array);
      this.attribute(this.points, "position", cloud.points, 3, gl.FLOAT);
      const colors = this.attribute(this.points, "color", cloud.colors, 3, gl.UNSIGNED_BYTE);
      this.clouds[name] = { array, colors, count: cloud.points.length / 3 };
    }
    this.lines = { array: gl.createVertexArray(), ranges: lines.ranges };
    gl.bindVertexArray(this.lines.array);
    this.attribute(this.strokes, "position", lines.vertices, 3, gl.FLOAT);
    this.attribute(this.strokes, "color", lines.colors, 3, gl.UNSIGNED_BYTE);
    this.attribute(this.strokes, "end", lines.ends, 1, gl.FLOAT);
    this.colorMap = gl.createTexture();
    this.depthMap = gl.createTexture();
    this.frame = gl.createFramebuffer();
    this.size = [0, 0];
  }

  program(vertex, fragment) {
    const gl = this.gl, program = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader) || "shader");
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program) || "program");
    const found = {};
    for (let i = 0; i < gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS); i++) {
      const name = gl.getActiveUniform(program, i).name;
      found[name] = gl.getUniformLocation(program, name);
    }
    return { program, uniforms: found };
  }

  attribute(owner, name, values, width, type) {
    const gl = this.gl, place = gl.getAttribLocation(owner.program, name), buffer = gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
    gl.bufferData(gl.ARRAY_BUFFER, values, gl.STATIC_DRAW);
    gl.enableVertexAttribArray(place);
    gl.vertexAttribPointer(place, width, type, type === gl.UNSIGNED_BYTE, 0, 0);
    return buffer;
  }

  recolor(name, colors) {
    this.gl.bindBuffer(this.gl.ARRAY_BUFFER, this.clouds[name].colors);
    this.gl.bufferData(this.gl.ARRAY_BUFFER, colors, this.gl.STATIC_DRAW);
  }

  resize(width, height) {
    if (this.size[0] === width && this.size[1] === height) return;
    const gl = this.gl;
    this.size = [width, height];
    this.canvas.width = width;
    this.canvas.height = height;
    const texture = (map, inner, format, type) => {
      gl.bindTexture(gl.TEXTURE_2D, map);
      gl.texImage2D(gl.TEXTURE_2D, 0, inner, width, height, 0, format, type, null);
      gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
      gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
    };
    texture(this.colorMap, gl.RGBA8, gl.RGBA, gl.UNSIGNED_BYTE);
    texture(this.depthMap, gl.DEPTH_COMPONENT24, gl.DEPTH_COMPONENT, gl.UNSIGNED_INT);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.frame);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, this.colorMap, 0);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.TEXTURE_2D, this.depthMap, 0);
  }

  draw(scene, width, height, ratio) {
    const gl = this.gl;
    this.resize(width, height);
    gl.viewport(0, 0, width, height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.frame);
    gl.disable(gl.BLEND);
    gl.enable(gl.DEPTH_TEST);
    gl.clearColor(0, 0, 0, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.useProgram(this.points.program);
    let u = this.points.uniforms;
    gl.uniformMatrix4fv(u.view, false, scene.view);
    gl.uniformMatrix4fv(u.projection, false, scene.projection);
    gl.uniform1f(u.size, scene.diameter * scene.pixelsPerUnit);
    gl.uniform1f(u.least, 1.5 * ratio);
    for (const { name, model } of scene.clouds) {
      gl.uniformMatrix4fv(u.model, false, model);
      gl.bindVertexArray(this.clouds[name].array);
      gl.drawArrays(gl.POINTS, 0, this.clouds[name].count);
    }
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.disable(gl.DEPTH_TEST);
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, this.colorMap);
    gl.activeTexture(gl.TEXTURE1);
    gl.bindTexture(gl.TEXTURE_2D, this.depthMap);
    gl.useProgram(this.shade.program);
    u = this.shade.uniforms;
    gl.uniform1i(u.colors, 0);
    gl.uniform1i(u.depths, 1);
    gl.uniform3fv(u.background, scene.background.map((v) => v / 255));
    gl.uniform1f(u.near, scene.near);
    gl.uniform1f(u.far, scene.far);
    gl.uniform1f(u.reach, 1.5 * ratio);
    gl.uniform1f(u.strength, 9);
    gl.bindVertexArray(this.whole);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
    gl.useProgram(this.strokes.program);
    u = this.strokes.uniforms;
    gl.uniform1i(u.depths, 1);
    gl.uniformMatrix4fv(u.model, false, scene.model);
    gl.uniformMatrix4fv(u.view, false, scene.view);
    gl.uniformMatrix4fv(u.projection, false, scene.projection);
    gl.bindVertexArray(this.lines.array);
    scene.classes.forEach((visible, i) => {
      const [first, count] = this.lines.ranges[i];
      if (visible && count) gl.drawArrays(gl.LINES, 2 * first, 2 * count);
    });
  }

  /** Share of pixels that are not background; to be called in the same task as draw. */
  covered(background) {
    const gl = this.gl, [width, height] = this.size, pixels = new Uint8Array(4 * width * height);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
    return shareOfInk(pixels, background);
  }
}

/** The same picture without a graphics card: a z-buffer in plain JavaScript, lines on top. */
class PlainRenderer {
  constructor(canvas, clouds, lines) {
    this.kind = "canvas2d";
    this.canvas = canvas;
    this.context = canvas.getContext("2d", { alpha: false });
    if (!this.context) throw new Error("no canvas");
    this.clouds = clouds;
    this.lines = lines;
    this.size = [0, 0];
  }

  recolor(name, colors) {
    this.clouds[name].colors = colors;
  }

  draw(scene, width, height, ratio) {
    if (this.size[0] !== width || this.size[1] !== height) {
      this.size = [width, height];
      this.canvas.width = width;
      this.canvas.height = height;
      this.image = this.context.createImageData(width, height);
      this.depth = new Float32Array(width * height);
      this.tint = new Uint8Array(3 * width * height);
    }
    const { depth, tint, image } = this;
    depth.fill(Infinity);
    for (const { name, model } of scene.clouds) this.splat(this.clouds[name], multiply(scene.view, model), scene, ratio);
    const out = image.data, ground = scene.background, reach = Math.max(1, Math.round(1.5 * ratio));
    for (let y = 0; y < height; y++) for (let x = 0; x < width; x++) {
      const at = y * width + x, here = depth[at];
      if (here === Infinity) {
        out[4 * at] = ground[0]; out[4 * at + 1] = ground[1]; out[4 * at + 2] = ground[2];
      } else {
        let sum = 0;
        for (let k = 0; k < 4; k++) {
          const nx = x + (k === 0 ? reach : k === 1 ? -reach : 0), ny = y + (k === 2 ? reach : k === 3 ? -reach : 0);
          if (nx < 0 || ny < 0 || nx >= width || ny >= height) continue;
          const there = depth[ny * width + nx];
          if (there < here) sum += Math.min(0.03, Math.log2(here / there));
        }
        const shade = 0.25 + 0.75 * Math.exp(-18 * sum);
        out[4 * at] = tint[3 * at] * shade; out[4 * at + 1] = tint[3 * at + 1] * shade; out[4 * at + 2] = tint[3 * at + 2] * shade;
      }
      out[4 * at + 3] = 255;
    }
    this.context.putImageData(image, 0, 0);
    this.strokes(scene, ratio);
  }

  splat(cloud, seen, scene, ratio) {
    const [width, height] = this.size, { depth, tint } = this, { points, colors } = cloud;
    const scale = scene.pixelsPerUnit;
    for (let i = 0; i < points.length; i += 3) {
      const x = points[i], y = points[i + 1], z = points[i + 2];
      const away = -(seen[2] * x + seen[6] * y + seen[10] * z + seen[14]);
      if (away <= scene.near) continue;
      const across = width / 2 + scale * (seen[0] * x + seen[4] * y + seen[8] * z + seen[12]) / away;
      const down = height / 2 - scale * (seen[1] * x + seen[5] * y + seen[9] * z + seen[13]) / away;
      const edge = Math.min(24, Math.max(1, Math.round(Math.max(1.5 * ratio, scene.diameter * scale / away))));
      const left = Math.round(across - edge / 2), top = Math.round(down - edge / 2);
      for (let py = Math.max(top, 0); py < Math.min(top + edge, height); py++) {
        for (let px = Math.max(left, 0); px < Math.min(left + edge, width); px++) {
          const at = py * width + px;
          if (away < depth[at]) {
            depth[at] = away;
            tint[3 * at] = colors[i]; tint[3 * at + 1] = colors[i + 1]; tint[3 * at + 2] = colors[i + 2];
          }
        }
      }
    }
  }

  strokes(scene, ratio) {
    const [width, height] = this.size, { vertices, colors, ranges } = this.lines, context = this.context;
    const sourceSeen = multiply(scene.view, scene.model), targetSeen = scene.view, scale = scene.pixelsPerUnit;
    const place = (seen, i) => {
      const x = vertices[i], y = vertices[i + 1], z = vertices[i + 2];
      const away = -(seen[2] * x + seen[6] * y + seen[10] * z + seen[14]);
      if (away <= scene.near) return null;
      return [width / 2 + scale * (seen[0] * x + seen[4] * y + seen[8] * z + seen[12]) / away,
        height / 2 - scale * (seen[1] * x + seen[5] * y + seen[9] * z + seen[13]) / away];
    };
    context.lineWidth = ratio;
    context.globalAlpha = 0.6;
    scene.classes.forEach((visible, kind) => {
      const [first, count] = ranges[kind];
      if (!visible || !count) return;
      context.strokeStyle = `rgb(${colors[6 * first]},${colors[6 * first + 1]},${colors[6 * first + 2]})`;
      context.beginPath();
      for (let k = first; k < first + count; k++) {
        const a = place(sourceSeen, 6 * k), b = place(targetSeen, 6 * k + 3);
        if (a && b) { context.moveTo(a[0], a[1]); context.lineTo(b[0], b[1]); }
      }
      context.stroke();
    });
    context.globalAlpha = 1;
  }

  covered(background) {
    return shareOfInk(this.context.getImageData(0, 0, ...this.size).data, background);
  }
}

function shareOfInk(pixels, background) {
  let inked = 0;
  for (let i = 0; i < pixels.length; i += 4) {
    const off = Math.abs(pixels[i] - background[0]) + Math.abs(pixels[i + 1] - background[1]) + Math.abs(pixels[i + 2] - background[2]);
    if (off > 12) inked++;
  }
  return inked / (pixels.length / 4);
}
