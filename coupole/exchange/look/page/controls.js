// The panel: what is set there goes into the state, and the state is shown there.

const byId = (name) => document.getElementById(name);

const LIGHT_INPUTS = {
  strength: (value) => `${value.toFixed(2)}`, softness: (value) => `${value.toFixed(1)}°`,
  kelvin: (value) => `${value} K`,
};

const choices = (named) => Object.entries(named).map(([value, text]) => new Option(text, value));

class Controls {
  /** `changed(what)` is called when the user has changed the state: "light", "mode" or "screen". */
  constructor(app, changed) {
    this.app = app;
    this.changed = changed;
    byId("mode").append(...choices(MODES));
    byId("quantity").append(...choices(UNCERTAIN));
    this.listenToPicture();
    this.listenToLight();
    this.beside = new Beside(app);
    new Printer(app);
  }

  get state() {
    return this.app.state;
  }

  get isRun() {
    return this.app.about.kind === "run";
  }

  get light() {
    return this.state.lights[this.state.chosen];
  }

  on(name, event, act) {
    byId(name).addEventListener(event, () => act(byId(name)));
  }

  listenToPicture() {
    this.on("mode", "change", (input) => {
      this.state.mode = input.value;
      this.changed("mode");
    });
    this.on("quantity", "change", (input) => {
      this.state.quantity = input.value;
      this.changed("mode");
    });
    this.on("relief", "input", (input) => {
      this.state.relief = input.valueAsNumber;
      this.changed("light");
    });
    this.on("white", "change", (input) => {
      if (input.valueAsNumber > 0) this.state.white = input.valueAsNumber;
      this.changed("screen");
    });
    if (!this.isRun) byId("view").append(new Option("None", ""));
    byId("view").append(...this.app.about.views.map(({ name }) => new Option(name, name)));
    for (const name of ["sky-row", "split-row", "frame-told"]) byId(name).hidden = this.isRun;
    byId("shot-section").hidden = !this.isRun;
    byId("frames-section").querySelector("summary").textContent = this.isRun ? "View" : "Measured frames";
    byId("frames-section").open = this.isRun;
    byId("frames-section").hidden = !this.app.about.views.length;
    this.on("view", "change", (input) => this.app.compare(input.value));
    this.on("split", "input", (input) => {
      this.state.split = input.valueAsNumber;
      this.changed("light");
    });
    this.on("with-residual", "change", (input) => {
      this.state.withResidual = input.value === "yes";
      this.changed("light");
    });
    byId("stereo-row").hidden = !["mesh", "scene"].includes(this.app.about.kind);
    for (const name of ["kelvin", "colour"]) byId(name).closest("label").hidden = this.app.about.kind === "scene";
    this.on("stereo", "change", (input) => {
      this.state.stereo = input.value === "two";
      this.changed("light");
    });
    this.on("auto-white", "click", () => this.app.fitWhite());
  }

  listenToLight() {
    for (const name of Object.keys(LIGHT_INPUTS)) {
      this.on(name, "input", (input) => {
        this.light[name] = input.valueAsNumber;
        this.changed("light");
      });
    }
    this.on("colour", "input", (input) => {
      this.light.colour = input.value;
      this.changed("light");
    });
    this.on("sky", "input", (input) => {
      this.state.sky = input.valueAsNumber;
      this.changed("light");
    });
    byId("environment-row").hidden = !this.app.about.environment;
    this.on("environment", "input", (input) => {
      this.state.environment = input.valueAsNumber;
      this.changed("light");
    });
    byId("illuminant").append(...Object.entries(ILLUMINANTS).map(([name, { told }]) => new Option(told, name)));
    this.on("illuminant", "change", (input) => {
      this.light.illuminant = input.value;
      this.changed("light");
    });
    byId("sky-illuminant-row").hidden = this.app.about.kind !== "scene";
    byId("sky-illuminant").append(...Object.entries(ILLUMINANTS).map(([name, { told }]) => new Option(told, name)));
    this.on("sky-illuminant", "change", (input) => {
      this.state.skyIlluminant = input.value;
      this.changed("light");
    });
    this.on("adapted", "change", (input) => {
      this.state.adapted = input.value === "yes";
      this.changed("screen");
    });
    byId("preset-row").hidden = this.app.about.kind === "scene" || this.isRun;
    const hasLeds = this.app.about.views.some(({ frames }) => frames?.length);
    byId("preset").append(...Object.entries(PRESETS).filter(([name]) => name !== "dome" || hasLeds).map(([name, { told }]) => new Option(told, name)));
    this.on("preset", "change", (input) => this.lightAs(PRESETS[input.value]));
    for (const name of ["azimuth", "height"]) {
      this.on(name, "input", () => {
        this.light.direction = wayOf(byId("azimuth").valueAsNumber, byId("height").valueAsNumber);
        this.changed("light");
      });
    }
    byId("lights").addEventListener("click", (event) => this.pressed(event.target.dataset.act));
  }

  /** Put a preset's light in the place of all lights. */
  lightAs(preset) {
    byId("preset").value = "";
    if (!preset) return;
    const light = presetLight(preset, this.state.camera);
    if (preset === PRESETS.dome) light.direction = this.app.renderer.nearestLed(this.light.direction);
    Object.assign(this.state, { lights: [light], chosen: 0, sky: preset.sky });
    if (this.app.about.environment) this.state.environment = 0;
    this.changed("light");
  }

  pressed(act) {
    const { state } = this;
    if (act === "add" && state.lights.length < MOST_LIGHTS) {
      const [azimuth, height] = anglesOf(this.light.direction);
      state.lights.push({ ...this.light, direction: wayOf(azimuth + 70, height) });
      state.chosen = state.lights.length - 1;
    } else if (act === "remove" && state.lights.length > 1) {
      state.lights.splice(state.chosen, 1);
      state.chosen = Math.max(0, state.chosen - 1);
    } else if (act?.startsWith("light ")) {
      state.chosen = Number(act.slice(6));
    } else {
      return;
    }
    this.changed("light");
    byId("lights").querySelector(`[data-act="${act}"]:not(:disabled)`)?.focus();
  }

  /** Put the state into the panel. */
  show() {
    const { state, light } = this;
    byId("mode").value = state.mode;
    byId("quantity").value = state.quantity;
    byId("relief").value = state.relief;
    byId("view").value = state.view;
    byId("split").value = state.split;
    byId("split").disabled = !state.view;
    byId("quantity-row").hidden = state.mode !== "uncertainty";
    byId("relief-row").hidden = state.mode !== "unsharp";
    byId("residual-row").hidden = !this.app.about.residual || state.mode !== "relit";
    byId("with-residual").value = state.withResidual ? "yes" : "no";
    byId("white-row").hidden = !isLit(state.mode) || Boolean(state.view && !this.isRun);
    if (document.activeElement !== byId("white")) byId("white").value = Number(state.white.toPrecision(4));
    byId("legend").innerHTML = ["roughness", "uncertainty", "residual"].includes(state.mode)
      ? legendOf(state.mode, state.quantity) : "";
    for (const [name, told] of Object.entries(LIGHT_INPUTS)) this.put(name, light[name], told(light[name]));
    const [azimuth, height] = anglesOf(light.direction);
    this.put("azimuth", azimuth, `${azimuth.toFixed(0)}°`);
    this.put("height", height, `${height.toFixed(0)}°`);
    this.put("sky", state.sky, state.sky.toFixed(2));
    this.put("environment", state.environment, state.environment.toFixed(2));
    byId("stereo").value = state.stereo ? "two" : "one";
    byId("illuminant").value = light.illuminant ?? "";
    byId("sky-illuminant").value = state.skyIlluminant ?? "";
    byId("kelvin").disabled = Boolean(light.illuminant);
    byId("adapted").value = state.adapted ? "yes" : "no";
    byId("colour").value = light.colour;
    if (this.isRun) byId("shot").innerHTML = this.app.renderer.shotTold(state);
    this.beside.show();
    this.showLights();
  }

  put(name, value, told) {
    if (document.activeElement !== byId(name)) byId(name).value = value;
    byId(name).parentElement.querySelector("output").textContent = told;
  }

  showLights() {
    const { state } = this, full = state.lights.length >= MOST_LIGHTS;
    const button = (act, text, label, more = "") => `<button type="button" data-act="${act}" aria-label="${label}"
      ${more}>${text}</button>`;
    const made = state.lights.map((_, k) => button(
      `light ${k}`, k + 1, `Light ${k + 1}`, `aria-pressed="${k === state.chosen}"`,
    ));
    made.push(button("add", "+", "Add a light", full ? "disabled" : ""));
    made.push(button("remove", "−", "Remove this light", state.lights.length > 1 ? "" : "disabled"));
    const markup = made.join("");
    if (this.lightsShown === markup) return;
    this.lightsShown = markup;
    const focused = document.activeElement?.dataset?.act;
    byId("lights").innerHTML = markup;
    if (focused) byId("lights").querySelector(`[data-act="${focused}"]`)?.focus();
  }
}

/** Whether a mode shows light, and not a number or a direction. */
const isLit = (mode) => !["normals", "roughness", "uncertainty", "residual"].includes(mode);
