// The page: pointer, keys and panel.

const byId = (name) => document.getElementById(name);
const TURN_PER_PX = 0.4, KEY_DEG = 8;

class Pick {
  constructor(mesh) {
    this.canvas = byId("picture");
    this.surface = new Surface(mesh);
    this.drawing = new Drawing(this.canvas, this.surface);
    this.parts = new Parts(this.surface.count);
    this.chosen = 1;
    this.tool = "turn";
    byId("brush").value = (this.surface.radius * 0.03).toPrecision(2);
    this.resize();
    this.showAll();
    this.parts.names = [...mesh.names];
    if (mesh.names.length) this.list();
    else this.add();
    this.listen();
    new ResizeObserver(() => this.resize()).observe(byId("stage"));
    byId("status").textContent = "";
  }

  // -- what is seen

  resize() {
    const { clientWidth, clientHeight } = byId("stage");
    this.canvas.width = Math.max(1, clientWidth);
    this.canvas.height = Math.max(1, clientHeight);
    if (this.camera) this.draw();
  }

  showAll() {
    this.camera = startCamera(this.surface.box, this.canvas.width, this.canvas.height, 8);
    this.draw();
  }

  look(camera) {
    this.camera = camera;
    this.draw();
  }

  draw() {
    const light = matchMedia("(prefers-color-scheme: light)").matches;
    const { width, height } = this.canvas;
    this.drawing.draw(this.camera, this.surface, width, height, light ? [0.9, 0.89, 0.87] : [0.07, 0.08, 0.09]);
  }

  painted() {
    this.drawing.paint(this.parts.of, this.parts.palette.map((rgb) => [...rgb, 255]));
    this.draw();
    const total = this.surface.count, done = this.parts.of.reduce((sum, part) => sum + (part > 0), 0);
    byId("told").textContent = `${done} of ${total} triangles are painted.`;
    byId("undo").disabled = !this.parts.strokes.length;
  }

  // -- parts

  add() {
    if (this.parts.names.length >= MOST_PARTS) return;
    this.parts.names.push(`part ${this.parts.names.length + 1}`);
    this.chosen = this.parts.names.length;
    this.list();
  }

  /** The list of parts in the panel: not painted, then each with its name. */
  list() {
    const rows = ["not painted", ...this.parts.names].map((name, part) => {
      const row = document.createElement("div"), choice = document.createElement("input");
      const swatch = document.createElement("span");
      row.className = "part";
      Object.assign(choice, { type: "radio", name: "part", checked: part === this.chosen });
      choice.setAttribute("aria-label", `Paint as ${name}`);
      choice.addEventListener("change", () => { this.chosen = part; });
      swatch.className = "swatch";
      swatch.style.background = `rgb(${this.parts.palette[part]})`;
      row.append(choice, swatch, part ? this.nameField(part) : document.createTextNode(name));
      return row;
    });
    byId("parts").replaceChildren(...rows);
    this.painted();
  }

  nameField(part) {
    const field = document.createElement("input");
    Object.assign(field, { value: this.parts.names[part - 1], maxLength: 64 });
    field.setAttribute("aria-label", `Name of part ${part}`);
    field.addEventListener("input", () => { this.parts.names[part - 1] = field.value.trim(); });
    return field;
  }

  // -- the brush

  /** Paint at a place of the picture; whether the object is there. */
  paintAt(x, y) {
    const { width, height } = this.canvas, way = wayThrough(this.camera, width, height, x, y);
    const met = metBy(this.surface, axesOf(this.camera).place, way), radius = Number(byId("brush").value);
    if (!met || !(radius > 0)) return false;
    this.parts.paint(coveredBy(this.surface, met, radius), this.chosen);
    this.painted();
    return true;
  }

  undo() {
    this.parts.undo();
    this.painted();
  }

  stroke(places) {
    this.parts.begin();
    for (const [x, y] of places) this.paintAt(x, y);
    this.parts.end();
    this.painted();
  }

  // -- files

  save() {
    const wrong = this.parts.wrong();
    byId("status").textContent = wrong;
    if (wrong) return;
    const link = document.createElement("a");
    link.href = URL.createObjectURL(new Blob([this.parts.file()], { type: "application/json" }));
    link.download = "parts.json";
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
  }

  async open(file) {
    try {
      this.parts.read(await file.text());
      this.chosen = 1;
      byId("status").textContent = "";
      this.list();
    } catch (error) {
      byId("status").textContent = `${file.name}: ${error.message}.`;
    }
  }

  // -- pointer and keys

  listen() {
    const { canvas } = this;
    canvas.addEventListener("pointerdown", (event) => this.down(event));
    canvas.addEventListener("pointermove", (event) => this.move(event));
    for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, () => this.up());
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("keydown", (event) => this.key(event));
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.look(zoomed(this.camera, Math.exp(0.0012 * event.deltaY), this.surface.radius));
    }, { passive: false });
    document.addEventListener("keydown", (event) => {
      if ((event.ctrlKey || event.metaKey) && event.key.toLowerCase() === "z" && event.target.tagName !== "INPUT") {
        event.preventDefault();
        this.undo();
      }
    });
    for (const button of document.querySelectorAll("[data-tool]")) {
      button.addEventListener("click", () => this.use(button.dataset.tool));
    }
    byId("undo").addEventListener("click", () => this.undo());
    byId("whole").addEventListener("click", () => this.showAll());
    byId("add").addEventListener("click", () => this.add());
    byId("save").addEventListener("click", () => this.save());
    byId("open").addEventListener("change", (event) => event.target.files[0] && this.open(event.target.files[0]));
  }

  use(tool) {
    this.tool = tool;
    this.canvas.classList.toggle("paints", tool === "paint");
    for (const button of document.querySelectorAll("[data-tool]")) {
      button.setAttribute("aria-pressed", String(button.dataset.tool === tool));
    }
  }

  down(event) {
    this.canvas.setPointerCapture(event.pointerId);
    this.canvas.focus({ focusVisible: false });
    const paints = event.button === 0 && !event.shiftKey && (this.tool === "paint" || event.ctrlKey);
    this.drag = { last: [event.offsetX, event.offsetY], paints, moves: event.button === 2 || event.shiftKey };
    if (paints) {
      this.parts.begin();
      this.paintAt(event.offsetX, event.offsetY);
    }
  }

  move(event) {
    if (!this.drag) return;
    const { last, paints, moves } = this.drag, x = event.offsetX - last[0], y = event.offsetY - last[1];
    this.drag.last = [event.offsetX, event.offsetY];
    const shorter = Math.min(this.canvas.width, this.canvas.height);
    if (paints) this.paintAt(event.offsetX, event.offsetY);
    else if (moves) this.look(moved(this.camera, x, y, shorter));
    else this.look(turned(this.camera, -x * TURN_PER_PX, y * TURN_PER_PX));
  }

  up() {
    if (this.drag?.paints) {
      this.parts.end();
      this.painted();
    }
    this.drag = null;
  }

  key(event) {
    const way = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[event.key];
    if (event.ctrlKey || event.metaKey) return;
    if (way) this.look(turned(this.camera, way[0] * KEY_DEG, way[1] * KEY_DEG));
    else if (event.key === "+" || event.key === "=") this.look(zoomed(this.camera, 0.9, this.surface.radius));
    else if (event.key === "-") this.look(zoomed(this.camera, 1 / 0.9, this.surface.radius));
    else if (event.key === "Enter") this.stroke([[this.canvas.width / 2, this.canvas.height / 2]]);
    else return;
    event.preventDefault();
  }
}

try {
  window.coupolePick = new Pick(MESH);
} catch (error) {
  byId("status").textContent = `The mesh cannot be shown: ${error.message}`;
}
