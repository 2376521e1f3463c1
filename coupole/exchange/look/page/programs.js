// WebGL 2: shaders, textures of the object's numbers, and what is drawn into.

const ROW = 4096;

/** What stands before a shader. */
const BEFORE = { "light.frag": ["shade.glsl", "texels.glsl"], "scene.vert": ["face.glsl"], "scene.frag": ["shade.glsl", "face.glsl"] };

function compiled(gl, kind, name) {
  const shader = gl.createShader(kind);
  const parts = ["common.glsl", ...BEFORE[name] ?? [], name];
  gl.shaderSource(shader, parts.map((part) => SHADERS[part]).join("\n"));
  gl.compileShader(shader);
  if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) {
    throw new Error(`${name}: ${gl.getShaderInfoLog(shader)}`);
  }
  return shader;
}

/** A program of two shaders; `at` finds where its uniforms are. */
function programOf(gl, vertex, fragment) {
  const program = gl.createProgram();
  gl.attachShader(program, compiled(gl, gl.VERTEX_SHADER, vertex));
  gl.attachShader(program, compiled(gl, gl.FRAGMENT_SHADER, fragment));
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) {
    throw new Error(`${vertex}, ${fragment}: ${gl.getProgramInfoLog(program)}`);
  }
  const places = {};
  const at = (name) => places[name] ??= gl.getUniformLocation(program, name);
  return { program, at };
}

function plainTexture(gl, target) {
  gl.bindTexture(target, gl.createTexture());
  for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(target, name, gl.NEAREST);
  for (const name of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(target, name, gl.CLAMP_TO_EDGE);
  return gl.getParameter(target === gl.TEXTURE_2D ? gl.TEXTURE_BINDING_2D : gl.TEXTURE_BINDING_2D_ARRAY);
}

/** Which formats hold an array of `count` numbers of a type beside each other. */
function formatOf(gl, dtype, count) {
  const formats = {
    "uint8 4": [gl.RGBA8UI, gl.RGBA_INTEGER, gl.UNSIGNED_BYTE],
    "float32 4": [gl.RGBA32F, gl.RGBA, gl.FLOAT],
    "uint16 2": [gl.RG16UI, gl.RG_INTEGER, gl.UNSIGNED_SHORT],
    "uint16 3": [gl.RGB16UI, gl.RGB_INTEGER, gl.UNSIGNED_SHORT],
    "uint32 3": [gl.RGB32UI, gl.RGB_INTEGER, gl.UNSIGNED_INT],
    "float16 2": [gl.RG16F, gl.RG, gl.HALF_FLOAT],
    "float16 3": [gl.RGB16F, gl.RGB, gl.HALF_FLOAT],
  };
  return formats[`${dtype} ${count}`];
}

/** A texture of numbers [n, count] in rows of `ROW`. */
function numbersTexture(gl, numbers, dtype, count) {
  const texture = plainTexture(gl, gl.TEXTURE_2D);
  const height = Math.max(1, Math.ceil(numbers.length / count / ROW));
  const whole = new numbers.constructor(height * ROW * count);
  whole.set(numbers);
  const [inside, format, type] = formatOf(gl, dtype, count);
  gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
  gl.texImage2D(gl.TEXTURE_2D, 0, inside, ROW, height, 0, format, type, whole);
  return texture;
}

/** A texture of rows of numbers that come later. */
function emptyTexture(gl, height, dtype, count) {
  const texture = plainTexture(gl, gl.TEXTURE_2D);
  gl.texStorage2D(gl.TEXTURE_2D, 1, formatOf(gl, dtype, count)[0], ROW, height);
  return texture;
}

/** Put numbers [n, count] into whole rows of a texture. */
function putRows(gl, texture, row, numbers, dtype, count) {
  const [, format, type] = formatOf(gl, dtype, count), height = numbers.length / count / ROW;
  gl.bindTexture(gl.TEXTURE_2D, texture);
  gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
  gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, row, ROW, height, format, type, numbers);
}

/** Layers of rows of four bytes that come later. */
function layersTexture(gl, layers, height) {
  const texture = plainTexture(gl, gl.TEXTURE_2D_ARRAY);
  gl.texStorage3D(gl.TEXTURE_2D_ARRAY, 1, gl.RGBA8, ROW, height, layers);
  return texture;
}

function putLayer(gl, texture, layer, row, bytes) {
  gl.bindTexture(gl.TEXTURE_2D_ARRAY, texture);
  gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
  const size = [ROW, bytes.length / 4 / ROW, 1];
  gl.texSubImage3D(gl.TEXTURE_2D_ARRAY, 0, 0, row, layer, ...size, gl.RGBA, gl.UNSIGNED_BYTE, bytes);
}

const MOST_FACTORS = 32;

/** For each light a row of factors, four floats each. */
function factorsTexture(gl) {
  const texture = plainTexture(gl, gl.TEXTURE_2D);
  gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA32F, MOST_FACTORS, MOST_LIGHTS);
  return texture;
}

function putFactors(gl, texture, rows) {
  gl.bindTexture(gl.TEXTURE_2D, texture);
  rows.forEach((row, number) => {
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, number, row.length / 4, 1, gl.RGBA, gl.FLOAT, row);
  });
}

/** Square tables of 16-bit floats [layers, side, side, 3], read between their numbers. */
function tablesTexture(gl, halves, side, layers) {
  const texture = plainTexture(gl, gl.TEXTURE_2D_ARRAY);
  for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D_ARRAY, name, gl.LINEAR);
  gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
  gl.texImage3D(gl.TEXTURE_2D_ARRAY, 0, gl.RGB16F, side, side, layers, 0, gl.RGB, gl.HALF_FLOAT, halves);
  return texture;
}

/** A texture of a picture of bytes [height, width, 3]. */
function bytesTexture(gl, bytes, width, height) {
  const texture = plainTexture(gl, gl.TEXTURE_2D);
  gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
  gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGB8, width, height, 0, gl.RGB, gl.UNSIGNED_BYTE, bytes);
  return texture;
}

/** A picture of four 32-bit integers for each pixel, to be drawn into; with a depth if it is asked. */
function pictureTarget(gl, width, height, withDepth) {
  const texture = plainTexture(gl, gl.TEXTURE_2D);
  gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA32UI, width, height);
  const frame = gl.createFramebuffer();
  gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
  gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, texture, 0);
  let depth = null;
  if (withDepth) {
    depth = gl.createRenderbuffer();
    gl.bindRenderbuffer(gl.RENDERBUFFER, depth);
    gl.renderbufferStorage(gl.RENDERBUFFER, gl.DEPTH_COMPONENT24, width, height);
    gl.framebufferRenderbuffer(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.RENDERBUFFER, depth);
  }
  const free = () => {
    gl.deleteTexture(texture);
    gl.deleteFramebuffer(frame);
    if (depth) gl.deleteRenderbuffer(depth);
  };
  return { texture, frame, free };
}

/** Depths of several lights, each a layer that is drawn into. */
function depthLayers(gl, size, layers) {
  const texture = plainTexture(gl, gl.TEXTURE_2D_ARRAY);
  gl.texStorage3D(gl.TEXTURE_2D_ARRAY, 1, gl.DEPTH_COMPONENT24, size, size, layers);
  const frames = Array.from({ length: layers }, (_, layer) => {
    const frame = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
    gl.framebufferTextureLayer(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, texture, 0, layer);
    return frame;
  });
  const free = () => {
    gl.deleteTexture(texture);
    frames.forEach((frame) => gl.deleteFramebuffer(frame));
  };
  return { texture, frames, layers, size, free };
}
