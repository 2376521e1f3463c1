// The page: what the user does, and when the picture is drawn.

const ADDRESS_MS = 300;
const LIGHT_PX = 160;  // that a dragged light goes from the middle to the rim
const MOST_PIXELS = 4e6;

const FIRST_PICTURE = "coupole: first picture";
const shown = () => new Promise((resolve) => requestAnimationFrame(() => setTimeout(resolve, 0)));
const RENDERERS = { mesh: Renderer, pictures: FlatRenderer, run: RunRenderer, scene: SceneRenderer };

class App {
  constructor(about, arrays) {
    this.about = about;
    this.canvas = byId("picture");
    this.renderer = new RENDERERS[about.kind](this.canvas, about, arrays);
    this.renderer.arrived = (error) => this.arrived(error);
    this.lost = new Set();
    this.theme = new Theme(() => this.changed("screen"));
    this.samples = new Samples(about);
    this.detail = new Detail();
    this.tool = "turn";
    this.ruler = [];
    this.pinned = null;
    this.most = SAMPLES;
    this.fitCanvas();
    const found = stateOf(location.hash.slice(1));
    this.state = found ?? startState();
    if (about.kind === "run") this.state.view ||= about.views[0].name;
    this.state.camera ??= this.wholeCamera = this.startCamera();
    this.controls = new Controls(this, (what) => this.changed(what));
    this.moving = new MovingLight(this);
    new Pointer(this, this.canvas, byId("sphere"));
    this.listen();
    this.tellAbout();
    if (about.picture_px) {
      byId("tools").querySelector("[data-tool=turn]").textContent = "Move";
      byId("mode").querySelector("[value=uncertainty]")?.remove();
    }
    this.isNew = !this.state.white;
    this.changed("light");
    if (!found) this.moving.begin();
  }

  get chosenLight() {
    return this.state.lights[this.state.chosen];
  }

  /** All of the mesh has come. */
  refine(arrays) {
    this.renderer.refine(arrays);
    this.changed("light");
  }

  startCamera() {
    if (this.about.start) return structuredClone(this.about.start.camera);
    const above = this.about.picture_px ? 90 : 50, { width, height } = this.canvas;
    const whole = startCamera(this.renderer.corners, width, height, above);
    return framed(whole, this.renderer.outline, width, height, this.freeArea());
  }

  /** The part of the canvas that neither words nor tools lie over, px: left, top, right, bottom. */
  freeArea() {
    const { width, height } = this.canvas, scale = height / Math.max(this.canvas.clientHeight, 1);
    const stage = byId("stage").getBoundingClientRect();
    const top = (byId("words").getBoundingClientRect().bottom - stage.top) * scale;
    const bottom = (byId("tools").getBoundingClientRect().top - stage.top) * scale;
    return bottom - top > height / 2 ? [0, top, width, bottom] : [0, 0, width, height];
  }

  /** Show or hide the settings. */
  showPanel(isShown) {
    byId("panel").hidden = !isShown;
    byId("settings").setAttribute("aria-expanded", String(isShown));
  }

  listen() {
    new ResizeObserver(() => this.resize()).observe(byId("stage"));
    window.addEventListener("hashchange", () => this.goTo(stateOf(location.hash.slice(1))));
    for (const name of ["focus", "blur"]) this.canvas.addEventListener(name, () => this.showMarks());
    this.canvas.addEventListener("webglcontextlost", () => this.say("The graphics failed: load the page again."));
    byId("tools").addEventListener("click", (event) => this.choose(event.target.dataset.tool));
    byId("settings").addEventListener("click", () => this.showPanel(byId("panel").hidden));
    byId("reset").addEventListener("click", () => this.showAll());
    byId("snapshot").addEventListener("click", () => this.snapshot());
    byId("link").addEventListener("click", () => this.copyLink());
    byId("notes").addEventListener("click", (event) => this.pressedNote(event.target.dataset));
    byId("save-notes").addEventListener("click", () => this.saveNotes());
    byId("load-notes").addEventListener("change", () => this.loadNotes(byId("load-notes")));
    byId("note-form").addEventListener("submit", (event) => {
      event.preventDefault();
      this.keepNote(byId("note-text").value.trim());
    });
  }

  /** Show a view's measured frame beside the fitted one; none for an empty name. */
  compare(name) {
    const view = viewOf(this.about, name), { width, height } = this.canvas;
    if (this.about.kind === "run") {
      this.state.view = name;
      this.changed("light");
      return;
    }
    this.state.view = view ? name : "";
    if (view) this.state.beside = "";
    this.state.camera = view ? cameraOf(view, this.renderer.corners, width, height) : this.startCamera();
    this.changed("light");
  }

  banner() {
    return this.renderer.banner(this.state);
  }

  /** Fetch what the picture lacks, one at a time. */
  async bring() {
    const wanted = this.missing();
    if (!wanted || this.isBringing) return;
    this.isBringing = true;
    if (wanted.told) this.say(wanted.told);
    try {
      await wanted.bring();
    } catch (error) {
      this.lost.add(wanted.name);
      this.say(error.message);
    }
    this.isBringing = false;
    this.changed("light");
  }

  /** The frame, the residual or the texels that are shown and have yet to come, and how. */
  missing() {
    const { renderer } = this, found = renderer.frameOf(this.state), view = renderer.missingResidual(this.state);
    const wanted = [];
    if (found && !found.texture) {
      const { frame } = found, { block: name } = frame;
      wanted.push({ name, bring: async () => renderer.keepFrame(frame, await laterBlock(this.about, name)) });
    }
    const other = renderer.missingBeside(this.state);
    if (other) wanted.push({ name: other.name, told: "Reading the other state…", bring: () => this.bringBeside() });
    if (view) wanted.push({ name: view.blocks[0], bring: () => renderer.residual.bring(view) });
    const tile = renderer.missingTexels;
    if (tile) wanted.push({ name: tile.blocks[0], bring: () => this.bringTexels(tile) });
    return wanted.find(({ name }) => !this.lost.has(name)) ?? null;
  }

  async bringTexels(tile) {
    const texels = this.renderer.bodies.map((body) => body.texels).find(({ wanted }) => wanted === tile);
    await texels.bring(tile);
    this.say(texels.told());
  }

  async bringBeside() {
    await this.renderer.bringBeside();
    this.say("");
  }

  /** More of the picture has come, or has failed to. */
  arrived(error) {
    if (error) this.say(error.message);
    this.schedule();
  }

  /** Wait until the tiles that are seen have come. */
  async tilesCome() {
    do {
      this.settle(1);
      await new Promise((resolve) => setTimeout(resolve, 10));
    } while (this.renderer.isWaiting);
  }

  /** Wait until all that the picture needs has come. */
  async whole() {
    do await this.tilesCome();
    while (this.missing());
  }

  /** Something of the state is new: all, or only how the mean is shown ("screen"). */
  changed(what) {
    if (what !== "screen") {
      this.renderer.restart();
      this.detail.moved();
    }
    this.controls.show();
    this.bring();
    byId("banner").textContent = this.banner();
    this.showSphere();
    this.showMarks();
    this.wanted = true;
    this.schedule();
    clearTimeout(this.addressed);
    this.addressed = setTimeout(() => history.replaceState(null, "", `#${addressOf(this.state)}`), ADDRESS_MS);
  }

  goTo(state) {
    if (!state) return;
    this.moving.stop();
    this.state = { ...state, camera: state.camera ?? this.startCamera(), white: state.white || this.state.white };
    this.changed("light");
  }

  schedule() {
    this.frame ??= requestAnimationFrame(() => {
      this.frame = null;
      this.goOn();
      if (this.renderer.samples < this.most) this.drawInTime();
      else if (this.wanted) this.renderer.show(this.state, this.theme.ground);
      this.wanted = false;
      if (this.moving.isMoving) setTimeout(() => this.schedule(), this.detail.took_ms);  // others want the machine too
      else if (this.renderer.samples < this.most || this.detail.share < 1) this.schedule();
    });
  }

  /** Go on with what moves by itself; what rests has all of its detail. */
  goOn() {
    if (this.moving.isMoving) {
      this.moving.step();
      this.detail.moved();
      this.renderer.restart();
      if (!byId("panel").hidden) this.showSphere();
    } else if (!this.detail.isInMotion && this.detail.restore() && this.fitCanvas()) {
      this.renderer.restart();
    }
    this.detail.frames += 1;
  }

  /** Draw; while something moves, in as much detail as comes fast enough. */
  drawInTime() {
    const begun = performance.now(), { isInMotion } = this.detail;
    this.draw();
    if (!isInMotion) return;
    this.renderer.read(0, 0, 1, 1);  // waits for it
    if (this.detail.isTooFine(performance.now() - begun) && this.fitCanvas()) this.renderer.restart();
    if (this.moving.isMoving && this.detail.isHopeless) this.moving.stop();
  }

  /** All of the detail, at once. */
  rest() {
    if (!this.detail.restore() || !this.fitCanvas()) return;
    this.renderer.restart();
    this.draw();
  }

  showSphere() {
    drawSphere(byId("sphere"), this.state.camera, this.state.lights, this.state.chosen, this.renderer.dome?.(this.state));
  }

  draw() {
    this.renderer.sample(this.state);
    if (!this.hasBegun && this.renderer.hasPicture) this.drawnFirst();
    this.renderer.show(this.state, this.theme.ground);
  }

  /** The first time that there is something to be seen. */
  drawnFirst() {
    this.hasBegun = true;
    if (this.isNew) this.state.white = this.renderer.brightest() || 1;
    this.controls.show();
    shown().then(() => performance.mark(FIRST_PICTURE));
  }

  /** Draw until the mean has so many samples. */
  settle(samples) {
    this.rest();
    while (this.renderer.samples < samples) this.draw();
    this.renderer.read(0, 0, 1, 1);  // waits for it
  }

  /** Give the canvas the pixels of its place on the page, and the mesh its detail; whether the pixels are others than
   * before. */
  fitCanvas() {
    this.renderer.isCoarse = this.detail.isCoarse;
    const { clientWidth: width, clientHeight: height } = byId("stage");
    const wished = Math.min(window.devicePixelRatio || 1, 2);
    this.scale = Math.min(wished, Math.sqrt(MOST_PIXELS / Math.max(width * height, 1))) * this.detail.share;
    const size = [width, height].map((side) => Math.max(1, Math.round(side * this.scale)));
    if (size[0] === this.canvas.width && size[1] === this.canvas.height) return false;
    [this.canvas.width, this.canvas.height] = size;
    return true;
  }

  resize() {
    if (!this.fitCanvas()) return;
    if (this.state.camera === this.wholeCamera) this.state.camera = this.wholeCamera = this.startCamera();
    this.renderer.restart();
    this.draw();
    this.changed("screen");
  }

  fitWhite() {
    const { white, mode } = this.state;
    this.state.mode = isLit(mode) ? mode : Object.keys(MODES)[0];
    this.renderer.restart();
    this.renderer.sample({ ...this.state, white: white || 1 });
    this.state.white = this.renderer.brightest() || 1;
    this.changed("screen");
  }

  // -- camera and light ------------------------------------------------------------------------------------------

  /** Go round the object by pixels that the pointer went; a measured picture moves instead. */
  turn(x, y) {
    if (this.about.picture_px) {
      this.move(x, y);
      return;
    }
    this.leaveFrame();
    const azimuth = -x * TURN_DEG_PER_PX, height = y * TURN_DEG_PER_PX;
    this.state.camera = turned(this.state.camera, azimuth, height);
    this.changed("light");
  }

  /** A mesh's measured frame is seen from its own camera alone. */
  leaveFrame() {
    if (this.about.kind === "mesh") this.state.view = "";
  }

  zoom(factor) {
    const { camera } = this.state;
    this.state.camera = camera.field
      ? { ...camera, field: clamp(camera.field * factor, 0.2, 120) }
      : zoomed(camera, factor, this.renderer.radius);
    this.changed("light");
  }

  move(x, y) {
    const shorter = Math.min(this.canvas.clientWidth, this.canvas.clientHeight);
    this.leaveFrame();
    this.state.camera = moved(this.state.camera, x, y, shorter);
    this.changed("light");
  }

  showAll() {
    this.leaveFrame();
    this.state.camera = this.wholeCamera = this.startCamera();
    this.changed("light");
  }

  /** Move the chosen light as its dot would go on the sphere, by pixels to the right and down. */
  dragLight(x, y) {
    const [a, b] = inView(this.state.camera, this.state.lights[this.state.chosen].direction);
    this.aim(a + x / LIGHT_PX, b - y / LIGHT_PX);
  }

  aim(x, y) {
    this.state.lights[this.state.chosen].direction = wayOn(this.state.camera, x, y);
    this.changed("light");
  }

  // -- points ----------------------------------------------------------------------------------------------------

  choose(tool) {
    if (!tool) return;
    this.tool = tool;
    for (const button of byId("tools").querySelectorAll("[data-tool]")) {
      button.setAttribute("aria-pressed", String(button.dataset.tool === tool));
    }
    this.canvas.classList.toggle("aims", tool === "measure" || tool === "note");
    this.say({ measure: "Click two places.", note: "Click a place." }[tool] ?? "");
  }

  click(x, y) {
    if (this.tool === "measure") this.measure(x, y);
    else if (this.tool === "note") this.pin(x, y);
    else this.tell(x, y);
  }

  /** What is seen at a place of the page. */
  seenAt(x, y) {
    this.rest();
    const found = this.renderer.seenAt(Math.floor(x * this.scale), Math.floor(y * this.scale));
    if (!found) this.say("The object is not at this place.");
    return found;
  }

  tell(x, y) {
    const found = this.seenAt(x, y);
    if (!found) return;
    if (this.about.kind === "run") {
      this.tellPixel(found.place, x, y);
      return;
    }
    if (this.about.kind === "scene") {
      this.tellPoint(this.renderer.toldAt(found));
      return;
    }
    const material = this.renderer.materialOf(found.triangle, found.body);
    const view = unit(minus(axesOf(this.state.camera).place, found.place));
    const angle = material ? degrees(Math.acos(clamp(dot(view, material.normal), -1, 1))) : 0;
    this.tellPoint(toldOf(found.triangle, found.place, material, Math.min(angle, PLOT.reach)));
    if (material && this.about.samples && !found.body) this.tellSamples(found, material);
  }

  /** Samples of a triangle, when they have come. */
  async tellSamples({ triangle, place }, material) {
    this.told = triangle;
    const said = byId("samples-told");
    said.textContent = "Reading the samples…";
    try {
      const samples = await this.samples.of(triangle, place, material);
      if (this.told === triangle) said.innerHTML = samplesTold(samples);
    } catch (error) {
      said.textContent = `No samples: ${error.message}`;
    }
  }

  /** What a pixel of a run has, as it is shown. */
  tellPixel(place, x, y) {
    this.settle(1);
    const shares = [...this.renderer.read(Math.floor(x * this.scale), Math.floor(y * this.scale), 1, 1)].slice(0, 3);
    const [column, row] = [place[0], this.about.picture_px[1] - place[1]].map(Math.floor);
    this.tellPoint(`<p>Pixel ${column}, ${row}: ${three(shares)}</p>
      <p class="small">Shares ${this.about.unit}; red, green, blue. ${escaped(this.banner())}</p>`);
  }

  tellPoint(markup) {
    byId("point").innerHTML = markup;
    this.showPanel(true);
    byId("point-section").open = true;
    byId("point-section").scrollIntoView({ block: "nearest" });
    this.say("");
  }

  measure(x, y) {
    const found = this.seenAt(x, y);
    if (!found) return;
    const { height, width } = this.canvas, normal = this.renderer.faceOf(found);
    const cosine = dot(normal, unit(minus(axesOf(this.state.camera).place, found.place)));
    const parts = partsOfEnd(this.about, this.state.camera, Math.min(width, height), found.place, cosine);
    this.ruler = [...this.ruler.slice(this.ruler.length === 2 ? 2 : 0), { place: found.place, parts }];
    if (this.ruler.length === 2) this.keepLength(measuredLength(this.about, this.ruler));
    else this.say("Now click the other end.");
    this.showMarks();
  }

  keepLength(measured) {
    this.say(`Straight distance ${measuredText(measured)}`);
    byId("lengths").append(Object.assign(document.createElement("li"), { textContent: lengthTold(measured) }));
  }

  pin(x, y) {
    const found = this.seenAt(x, y);
    if (!found) return;
    this.pinned = found.place;
    this.showPanel(true);
    byId("notes-section").open = true;
    byId("note-text").focus();
    this.say("Write the note, then press Enter.");
    this.showMarks();
  }

  keepNote(text) {
    if (!text || !this.pinned) {
      this.say(text ? "Click a place for the note first." : "Write the text of the note first.");
      return;
    }
    const { camera, lights } = structuredClone(this.state);
    const by = byId("note-by").value.trim();
    this.state.notes.push({ text, place: this.pinned, camera, lights, by, id: newId(), created: new Date().toISOString() });
    this.pinned = null;
    byId("note-text").value = "";
    this.say("");
    this.changed("screen");
  }

  saveNotes() {
    if (!this.state.notes.length) {
      this.say("There are no notes yet.");
      return;
    }
    for (const note of this.state.notes) {
      note.id ??= newId();
      note.created ??= new Date().toISOString();
    }
    const text = annotationsText(this.about, this.state.notes);
    saveAs(`${this.about.title}.annotations.jsonld`, new Blob([text], { type: "application/ld+json" }));
  }

  /** Add the notes of a file that somebody chose, in place of those of the same id. */
  async loadNotes(input) {
    const [file] = input.files;
    if (!file) return;
    try {
      const text = await file.text(), { camera, lights } = structuredClone(this.state);
      const found = notesOf(this.about, text, { camera, lights }, (place) => this.distanceTo(place), OFF_SURFACE * this.renderer.radius);
      const ids = new Set(found.map(({ id }) => id));
      this.state.notes = [...this.state.notes.filter(({ id }) => !ids.has(id)), ...found];
      this.changed("screen");
      this.say(`${found.length} ${found.length === 1 ? "note" : "notes"} of ${file.name}`);
    } catch (error) {
      this.say(`${file.name}: ${error.message}`);
    }
    input.value = "";
  }

  /** How far a place is from the surface; of pictures, from their rectangle, px. */
  distanceTo(place) {
    if (!this.about.picture_px) return distanceToMesh(this.renderer.bodies[0].arrays, this.about, place);
    const inside = this.about.picture_px.map((side, k) => clamp(place[k], 0, side));
    return length(minus(place, [...inside, 0]));
  }

  pressedNote({ show, remove }) {
    if (show !== undefined) {
      const { camera, lights } = structuredClone(this.state.notes[show]);
      this.leaveFrame();
      Object.assign(this.state, { camera, lights, chosen: 0 });
      this.changed("light");
    } else if (remove !== undefined) {
      this.state.notes.splice(Number(remove), 1);
      this.changed("screen");
    }
  }

  // -- what lies beside the picture ------------------------------------------------------------------------------

  showMarks() {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    const pins = this.pinned ? [...this.state.notes, { place: this.pinned }] : this.state.notes;
    byId("marks").setAttribute("viewBox", `0 0 ${width} ${height}`);
    const stereo = isStereo(this.state);
    byId("marks").innerHTML = stereo ? "" : marksOf(this.state.camera, width, height, pins, this.ruler)
      + splitOf(this.state, width, height)
      + (this.canvas.matches(":focus-visible") ? aimOf(width, height) : "");
    drawScale(byId("scale"), this.state.camera, Math.min(stereo ? width / 2 : width, height));
    byId("notes").replaceChildren(...this.state.notes.map((note, number) => {
      const line = document.createElement("li"), text = document.createElement("span");
      text.textContent = `${note.text} `;
      line.append(text);
      for (const [what, told] of [["show", "Show"], ["remove", "Remove"]]) {
        const button = Object.assign(document.createElement("button"), { type: "button", textContent: told });
        button.dataset[what] = number;
        button.setAttribute("aria-label", `${told} note ${number + 1}`);
        line.append(button, " ");
      }
      return line;
    }));
  }

  say(words) {
    byId("status").textContent = words;
  }

  tellAbout() {
    const { about } = this, told = {
      ...about.told,
      ...about.fit && { Fit: about.fit },
      "Written short": Object.entries(about.errors).map(([name, error]) => `${name}: ${error}`).join("; "),
      Software: Object.entries(about.software).map(([name, version]) => `${name} ${version}`).join(", "),
    };
    const list = document.createElement("dl");
    for (const [name, text] of Object.entries(told)) {
      list.append(
        Object.assign(document.createElement("dt"), { textContent: name }),
        Object.assign(document.createElement("dd"), { textContent: text }),
      );
    }
    byId("about").append(list);
  }

  /** The picture as a file, with what has to be said of it. */
  snapshot() {
    this.settle(this.most);
    const { width, height } = this.canvas, line = Math.round(26 * this.scale);
    const made = document.createElement("canvas");
    Object.assign(made, { width, height: height + line });
    const context = made.getContext("2d");
    context.fillStyle = this.theme.ground;
    context.fillRect(0, 0, width, height + line);
    context.drawImage(this.canvas, 0, 0);
    context.fillStyle = this.theme.text;
    context.font = `${Math.round(13 * this.scale)}px sans-serif`;
    const [shown, unit] = this.renderer.whiteOf(this.state);
    const white = isLit(this.state.mode) ? ` · white ${shown.toPrecision(4)} ${unit}` : "";
    const words = `${this.about.title} · ${MODES[this.state.mode]}${white} · ${this.banner()}`;
    context.fillText(words, 8 * this.scale, height + line * 0.68, width - 16 * this.scale);
    made.toBlob((blob) => saveAs(`${this.about.title}.png`, blob));
  }

  async copyLink() {
    history.replaceState(null, "", `#${addressOf(this.state)}`);
    try {
      await navigator.clipboard.writeText(location.href);
      this.say("The link is copied: view, light and notes are in it.");
    } catch {
      this.say("View, light and notes are in the address of this page: copy it from there.");
    }
  }
}
