// Dark or light: as the system has it, or as the user has chosen.

const THEMES = { system: "As the system", dark: "Dark", light: "Light" };

class Theme {
  /** `changed()` is called when the page has become dark or light. */
  constructor(changed) {
    this.isLight = window.matchMedia("(prefers-color-scheme: light)");
    this.select = byId("theme");
    this.select.append(...choices(THEMES));
    const put = () => {
      const { value } = this.select;
      document.documentElement.dataset.theme = value !== "system" ? value : this.isLight.matches ? "light" : "dark";
    };
    put();
    for (const source of [this.select, this.isLight]) {
      source.addEventListener("change", () => {
        put();
        changed();
      });
    }
  }

  /** The colour behind the object. */
  get ground() {
    return getComputedStyle(document.documentElement).getPropertyValue("--ground").trim();
  }

  get text() {
    return getComputedStyle(document.documentElement).getPropertyValue("--text").trim();
  }
}
