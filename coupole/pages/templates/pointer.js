(() => {
  const palettes = JSON.parse(document.getElementById("palettes").textContent);
  const places = {};
  for (const [name, colours] of Object.entries(palettes)) places[name] = new Map(colours.map((colour, k) => [parseInt(colour, 16), k]));
  const text = value => String(Number(value.toPrecision(3)));
  for (const map of document.querySelectorAll(".map")) {
    const image = map.querySelector("img"), said = map.parentElement.querySelector("output");
    const { palette, unit } = map.dataset, names = map.dataset.names.split(" ");
    const low = +map.dataset.low, high = +map.dataset.high, gamma = +map.dataset.gamma;
    const ring = map.appendChild(document.createElement("i"));
    ring.hidden = true;
    let pixels = null, column = 0, row = 0;
    function read() {
      if (pixels) return;
      const canvas = document.createElement("canvas");
      canvas.width = image.naturalWidth;
      canvas.height = image.naturalHeight;
      const pen = canvas.getContext("2d", { willReadFrequently: true });
      pen.drawImage(image, 0, 0);
      pixels = pen.getImageData(0, 0, canvas.width, canvas.height);
      column = canvas.width >> 1;
      row = canvas.height >> 1;
    }
    function valueAt(at) {
      const [red, green, blue, alpha] = pixels.data.slice(at, at + 4);
      if (alpha < 255) return "no value here";
      if (!palette) {
        const values = [red, green, blue].map(code => text(low + (high - low) * (code / 255) ** gamma));
        return names.map((name, k) => name + " " + values[k]).join(", ") + (unit && " " + unit);
      }
      const place = places[palette].get(red * 65536 + green * 256 + blue), most = palettes[palette].length - 1;
      return (place === most ? "at least " : "") + text(low + (high - low) * place / most) + (unit && " " + unit);
    }
    function show() {
      column = Math.min(Math.max(column, 0), pixels.width - 1);
      row = Math.min(Math.max(row, 0), pixels.height - 1);
      ring.hidden = false;
      ring.style.left = 100 * (column + 0.5) / pixels.width + "%";
      ring.style.top = image.clientHeight * (row + 0.5) / pixels.height + "px";
      said.textContent = valueAt(4 * (row * pixels.width + column));
    }
    function point(event) {
      read();
      const box = image.getBoundingClientRect();
      column = Math.floor((event.clientX - box.left) / box.width * pixels.width);
      row = Math.floor((event.clientY - box.top) / box.height * pixels.height);
      show();
    }
    map.addEventListener("pointermove", point);
    map.addEventListener("pointerdown", point);
    map.addEventListener("focus", () => { read(); show(); });
    map.addEventListener("keydown", event => {
      const steps = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
      if (!steps) return;
      event.preventDefault();
      read();
      const far = event.shiftKey ? 1 : Math.max(1, Math.round(pixels.width / 60));
      column += steps[0] * far;
      row += steps[1] * far;
      show();
    });
  }
})();
