// A picture at print size: PNG with its resolution, caption and scale bar.

const MM_PER_INCH = 25.4;
const MOST_PRINT_PIXELS = 12e6;
const PRINT_SAMPLES = 16;
const PAPER = { ground: "#ffffff", ink: "#000000" };
const TYPE_MM = 3, LINE_MM = 4.2, EDGE_MM = 3, BAR_SHARE = 0.3;
const PNG_SIGNATURE_BYTES = 8, PNG_HEADER_BYTES = 25;

/** Width and height of a picture on paper, px, of the canvas's proportions. Raises an Error outside of what can be drawn. */
function printSize(width_mm, dpi, canvas) {
  if (!isNumber(width_mm, 10, 1200)) throw new Error(`Width: expected 10 to 1200 mm, got ${width_mm}.`);
  if (!isNumber(dpi, 72, 1200)) throw new Error(`Resolution: expected 72 to 1200 dots per inch, got ${dpi}.`);
  const width = Math.round(width_mm / MM_PER_INCH * dpi), height = Math.round(width * canvas.height / canvas.width);
  if (width * height > MOST_PRINT_PIXELS) {
    const most = Math.floor(dpi * Math.sqrt(MOST_PRINT_PIXELS / (width * height)));
    throw new Error(`${width} x ${height} pixels are more than 12 million: choose at most ${most} dots per inch at this width.`);
  }
  return { width, height };
}

/** Millimetres of paper for one millimetre of the object where the camera looks. */
function printScale(camera, { width, height }, width_mm) {
  const seen_mm = 2 * halfFieldOf(camera) * camera.distance * width / Math.min(width, height);
  return width_mm / seen_mm;
}

/** Put the picture, a scale bar and lines of words on paper. `px_per_mm` is of the paper, `scale` paper over object. */
function paperOf(picture, words, px_per_mm, scale) {
  const { width, height } = picture, edge = EDGE_MM * px_per_mm, line = LINE_MM * px_per_mm;
  const made = document.createElement("canvas"), context = made.getContext("2d");
  const font = `${TYPE_MM * px_per_mm}px sans-serif`;
  context.font = font;
  const lines = words.flatMap((text) => wrapped(context, text, width - 2 * edge));
  Object.assign(made, { width, height: Math.ceil(height + edge + line * (lines.length + 1)) });
  context.fillStyle = PAPER.ground;
  context.fillRect(0, 0, made.width, made.height);
  context.drawImage(picture, 0, 0);
  context.fillStyle = PAPER.ink;
  context.font = font;
  lines.forEach((text, number) => context.fillText(text, edge, height + edge + line * (number + 0.7)));
  drawPaperBar(context, edge, height - edge, width * BAR_SHARE, px_per_mm * scale);
  return made;
}

/** A round length as a bar, of at most so many pixels. */
function drawPaperBar(context, x, y, most_px, px_per_unit) {
  const power = 10 ** Math.floor(Math.log10(most_px / px_per_unit));
  const size = power * [5, 2, 1].find((factor) => factor * power * px_per_unit <= most_px);
  const thick = parseFloat(context.font) / 5;
  context.fillRect(x, y - thick, size * px_per_unit, thick);
  context.fillText(lengthText(size), x, y - 2.5 * thick);
}

function wrapped(context, text, width) {
  const lines = [""];
  for (const word of text.split(" ")) {
    const longer = `${lines.at(-1)} ${word}`.trim();
    if (lines.at(-1) && context.measureText(longer).width > width) lines.push(word);
    else lines[lines.length - 1] = longer;
  }
  return lines;
}

/** The bytes of a PNG with its resolution (pHYs) and a description (iTXt), after its header. */
function withResolution(bytes, dpi, description) {
  const physical = new DataView(new ArrayBuffer(9)), per_m = Math.round(dpi / MM_PER_INCH * 1000);
  physical.setUint32(0, per_m);
  physical.setUint32(4, per_m);
  physical.setUint8(8, 1);
  const text = new TextEncoder().encode(`Description\0\0\0\0\0${description}`), at = PNG_SIGNATURE_BYTES + PNG_HEADER_BYTES;
  const chunks = [chunkOf("pHYs", new Uint8Array(physical.buffer)), chunkOf("iTXt", text)];
  return new Blob([bytes.subarray(0, at), ...chunks, bytes.subarray(at)], { type: "image/png" });
}

function chunkOf(name, content) {
  const made = new Uint8Array(content.length + 12), view = new DataView(made.buffer);
  view.setUint32(0, content.length);
  made.set(new TextEncoder().encode(name), 4);
  made.set(content, 8);
  view.setUint32(content.length + 8, crc32(made.subarray(4, content.length + 8)));
  return made;
}

/** CRC-32 of PNG (ISO 3309). */
function crc32(bytes) {
  let crc = 0xffffffff;
  for (const byte of bytes) {
    crc ^= byte;
    for (let k = 0; k < 8; k++) crc = crc >>> 1 ^ (crc & 1 ? 0xedb88320 : 0);
  }
  return (crc ^ 0xffffffff) >>> 0;
}

function saveAs(name, blob) {
  const link = Object.assign(document.createElement("a"), { href: URL.createObjectURL(blob), download: name });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 1000);
}

class Printer {
  constructor(app) {
    this.app = app;
    byId("print-button").addEventListener("click", () => this.print());
    byId("print-true").addEventListener("click", () => this.setTrueScale());
  }

  get width_mm() {
    return byId("print-width").valueAsNumber;
  }

  /** The width at which a millimetre of the object is a millimetre of paper. */
  setTrueScale() {
    const { state, canvas } = this.app;
    byId("print-width").value = (this.width_mm / printScale(state.camera, canvas, this.width_mm)).toFixed(1);
  }

  async print() {
    const { app } = this, dpi = Number(byId("print-dpi").value), button = byId("print-button");
    button.disabled = true;
    try {
      app.moving.stop();
      app.rest();
      const size = printSize(this.width_mm, dpi, app.canvas), scale = printScale(app.state.camera, app.canvas, this.width_mm);
      const words = this.words(scale);
      const paper = paperOf(await this.drawn(size), words, dpi / MM_PER_INCH, scale);
      const blob = await new Promise((resolve) => paper.toBlob(resolve));
      const png = withResolution(new Uint8Array(await blob.arrayBuffer()), dpi, words.join("\n"));
      saveAs(`${app.about.title}-print.png`, png);
      app.say("");
    } catch (error) {
      app.say(error.message);
    }
    button.disabled = false;
  }

  /** What stands below: the caption, what the picture is, from where its light comes, its scale. */
  words(scale) {
    const { state, about, renderer } = this.app, caption = byId("print-caption").value.trim();
    const lights = state.lights.map(({ direction }) => anglesOf(direction).map((angle) => `${angle.toFixed(0)}°`).join(" / "));
    const [white, unit] = renderer.whiteOf(state);
    const lit = isLit(state.mode) ? `; light from azimuth / height ${lights.join(", ")}; white ${white.toPrecision(3)} ${unit}` : "";
    const ratio = scale >= 1 ? `${scale.toPrecision(3)} : 1` : `1 : ${(1 / scale).toPrecision(3)}`;
    const size = about.picture_px ? "" : ` Scale ${ratio} in the middle of the picture (perspective).`;
    return [caption || about.title, `${MODES[state.mode]}${lit}. ${this.app.banner()}.${size}`];
  }

  /** The picture as it is, at another size; the canvas has its own size again afterwards. */
  async drawn({ width, height }) {
    const { app } = this, { canvas, renderer } = app, copy = Object.assign(document.createElement("canvas"), { width, height });
    try {
      Object.assign(canvas, { width, height });
      renderer.restart();
      for (let sample = 1; sample <= PRINT_SAMPLES; sample++) {
        app.say(`Drawing ${width} x ${height} pixels: ${sample} of ${PRINT_SAMPLES}…`);
        renderer.sample(app.state);
        renderer.read(0, 0, 1, 1);
        await new Promise((resolve) => setTimeout(resolve, 0));
      }
      renderer.show(app.state, PAPER.ground);
      copy.getContext("2d").drawImage(canvas, 0, 0);
    } finally {
      app.fitCanvas();
      renderer.restart();
      app.changed("light");
    }
    return copy;
  }
}
