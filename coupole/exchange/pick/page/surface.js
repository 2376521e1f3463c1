// The mesh as numbers, and how it is drawn: each triangle has one colour.

const VERTEX = `#version 300 es
uniform mat4 clip;
in vec3 place;
in vec4 colour;
out vec3 at;
flat out vec3 own;
void main() {
  at = place;
  own = colour.rgb;
  gl_Position = clip * vec4(place, 1.0);
}`;
const FRAGMENT = `#version 300 es
precision highp float;
uniform vec3 eye;
in vec3 at;
flat in vec3 own;
out vec4 shown;
void main() {
  vec3 normal = normalize(cross(dFdx(at), dFdy(at)));
  float facing = abs(dot(normal, normalize(eye - at)));
  shown = vec4(own * (0.25 + 0.75 * facing), 1.0);
}`;

/** The bytes of base64. */
function bytesOf(text) {
  return Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
}

function base64Of(bytes) {
  let letters = "";
  for (let k = 0; k < bytes.length; k += 32768) letters += String.fromCharCode(...bytes.subarray(k, k + 32768));
  return btoa(letters);
}

class Surface {
  constructor(mesh) {
    const vertices = new Float32Array(bytesOf(mesh.vertices_mm).buffer);
    const triangles = new Uint32Array(bytesOf(mesh.triangles).buffer);
    this.count = triangles.length / 3;
    this.corners = new Float32Array(this.count * 9);
    this.middles = new Float32Array(this.count * 3);
    this.normals = new Float32Array(this.count * 3);
    triangles.forEach((vertex, k) => this.corners.set(vertices.subarray(3 * vertex, 3 * vertex + 3), 3 * k));
    for (let k = 0; k < this.count; k++) {
      const [a, b, c] = [0, 3, 6].map((first) => [...this.corners.subarray(9 * k + first, 9 * k + first + 3)]);
      this.middles.set(times(add(add(a, b), c), 1 / 3), 3 * k);
      this.normals.set(unit(cross(minus(b, a), minus(c, a))), 3 * k);
    }
    const low = [Infinity, Infinity, Infinity], high = [-Infinity, -Infinity, -Infinity];
    for (let k = 0; k < this.corners.length; k++) {
      low[k % 3] = Math.min(low[k % 3], this.corners[k]);
      high[k % 3] = Math.max(high[k % 3], this.corners[k]);
    }
    this.middle = times(add(low, high), 0.5);
    this.radius = length(minus(high, low)) / 2;
    this.box = [0, 1, 2, 3, 4, 5, 6, 7].map((k) => [0, 1, 2].map((axis) => (k >> axis & 1 ? high : low)[axis]));
  }

  middleOf(k) {
    return [...this.middles.subarray(3 * k, 3 * k + 3)];
  }

  normalOf(k) {
    return [...this.normals.subarray(3 * k, 3 * k + 3)];
  }
}

class Drawing {
  constructor(canvas, surface) {
    const gl = canvas.getContext("webgl2", { antialias: true, preserveDrawingBuffer: true });
    if (!gl) throw new Error("this browser has no WebGL 2: open the page in another one");
    this.gl = gl;
    this.count = surface.count;
    this.program = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(this.program, shader);
    }
    gl.linkProgram(this.program);
    if (!gl.getProgramParameter(this.program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(this.program));
    this.attribute("place", surface.corners, 3, gl.FLOAT, false);
    this.colours = this.attribute("colour", new Uint8Array(this.count * 12), 4, gl.UNSIGNED_BYTE, true);
    gl.enable(gl.DEPTH_TEST);
  }

  attribute(name, numbers, size, type, normalised) {
    const { gl } = this, buffer = gl.createBuffer(), at = gl.getAttribLocation(this.program, name);
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
    gl.bufferData(gl.ARRAY_BUFFER, numbers, gl.DYNAMIC_DRAW);
    gl.enableVertexAttribArray(at);
    gl.vertexAttribPointer(at, size, type, normalised, 0, 0);
    return buffer;
  }

  /** Take the colour [r, g, b] of each triangle from its part. */
  paint(parts, palette) {
    const { gl } = this, bytes = new Uint8Array(this.count * 12);
    parts.forEach((part, k) => {
      for (let corner = 0; corner < 3; corner++) bytes.set(palette[part], 12 * k + 4 * corner);
    });
    gl.bindBuffer(gl.ARRAY_BUFFER, this.colours);
    gl.bufferSubData(gl.ARRAY_BUFFER, 0, bytes);
  }

  draw(camera, surface, width, height, ground) {
    const { gl } = this;
    gl.viewport(0, 0, width, height);
    gl.clearColor(...ground, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.useProgram(this.program);
    const clip = clipOf(camera, width, height, surface.middle, surface.radius, [0, 0]);
    gl.uniformMatrix4fv(gl.getUniformLocation(this.program, "clip"), false, clip);
    gl.uniform3fv(gl.getUniformLocation(this.program, "eye"), axesOf(camera).place);
    gl.drawArrays(gl.TRIANGLES, 0, this.count * 3);
  }
}
