// Arrays that the page carries as text: base64 of zlib of bytes that are sorted by their significance.

const TYPES = {
  uint8: Uint8Array, uint16: Uint16Array, uint32: Uint32Array, float16: Uint16Array, float32: Float32Array,
};

/** The numbers of a block; float16 as the 16 bits that they are. */
async function unpacked({ about, text }) {
  const packed = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  if (about.dtype === "jpeg") return pictured(packed, about.shape);
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  const rows = new Uint8Array(await new Response(stream).arrayBuffer());
  const Kind = TYPES[about.dtype];
  const size = Kind.BYTES_PER_ELEMENT, count = rows.length / size;
  const bytes = new Uint8Array(rows.length);
  for (let byte = 0; byte < size; byte++) {
    const row = rows.subarray(byte * count, (byte + 1) * count);
    for (let k = 0; k < count; k++) bytes[k * size + byte] = row[k];
  }
  return new Kind(bytes.buffer);
}

/** The bytes [h, w] or [h, w, 3] of a JPEG. */
async function pictured(packed, [height, width, channels = 1]) {
  const picture = await createImageBitmap(new Blob([packed], { type: "image/jpeg" }), { colorSpaceConversion: "none" });
  const canvas = Object.assign(document.createElement("canvas"), { width, height });
  const context = canvas.getContext("2d", { willReadFrequently: true });
  context.drawImage(picture, 0, 0);
  picture.close();
  const { data } = context.getImageData(0, 0, width, height), bytes = new Uint8Array(width * height * channels);
  for (let k = 0; k < width * height; k++) {
    for (let channel = 0; channel < channels; channel++) bytes[k * channels + channel] = data[4 * k + channel];
  }
  return bytes;
}

/** When all of the page's scripts were read. */
const allRead = new Promise((resolve) => {
  if (document.readyState === "loading") document.addEventListener("DOMContentLoaded", resolve);
  else resolve();
});

/** All blocks by their names; raises an error that names those that did not come. */
async function readBlocks(names) {
  if (!window.DecompressionStream) throw new Error("This page needs a browser of 2023 or later.");
  const missing = names.filter((name) => !(name in coupoleBlocks));
  if (missing.length) {
    throw new Error(`The page's data are missing (${missing.join(", ")}): keep its .data folder beside it.`);
  }
  const arrays = {};
  for (const name of names) {
    arrays[name] = await unpacked(coupoleBlocks[name]);
    delete coupoleBlocks[name];
  }
  return arrays;
}

/** The number that 16 bits stand for (IEEE 754 binary16). */
function half(bits) {
  const exponent = bits >> 10 & 31, share = bits & 1023;
  const size = exponent ? (1 + share / 1024) * 2 ** (exponent - 15) : share * 2 ** -24;
  return bits >> 15 ? -size : size;
}
