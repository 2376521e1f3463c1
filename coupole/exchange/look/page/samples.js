// Measured samples of a triangle, beside the prediction of its fit for the same directions.

/** Where a number stands in numbers that rise; -1 if it does not. */
function placeIn(numbers, wanted) {
  let [low, high] = [0, numbers.length];
  while (low < high) {
    const middle = (low + high) >> 1;
    if (numbers[middle] < wanted) low = middle + 1;
    else high = middle;
  }
  return numbers[low] === wanted ? low : -1;
}

const codedValue = (code) => 1e-4 * 1e5 ** ((code - 1) / 254);

const LEAST_COSINE = 0.05;  // of the light to the normal: below it f is noise

class Samples {
  constructor(about) {
    this.about = about;
    this.kept = {};
  }

  block(name) {
    return this.kept[name] ??= laterBlock(this.about, name);
  }

  /** Samples of a triangle in all views: f, 1/sr, and how far the half vector stands from the normal. */
  async of(triangle, centre, material) {
    const found = [];
    for (const view of this.about.samples) {
      const row = placeIn(await this.block(`samples-${view.name}-triangles`), triangle);
      if (row >= 0) found.push(...await this.ofView(view, row, centre, material));
    }
    return found;
  }

  async ofView({ name, rows, camera_mm: camera, view }, row, centre, material) {
    const [leds, codes] = await Promise.all([
      this.block(`samples-${name}-leds`), laterBlock(this.about, `samples-${name}-${Math.floor(row / rows)}`),
    ]);
    const count = leds.length / 3, third = codes.length / 3, first = (row % rows) * count;
    const away = unit(minus(camera, centre)), found = [];
    for (let led = 0; led < count; led++) {
      const code = codes[first + led];
      if (!code) continue;
      const way = unit(minus([leds[3 * led], leds[3 * led + 1], leds[3 * led + 2]], centre));
      const nh = dot(material.normal, unit(add(way, away))), nl = dot(material.normal, way);
      const nv = dot(material.normal, away);
      const [below, above] = [1, 2].map((k) => codes[k * third + first + led]).map((one) => one ? codedValue(one) : null);
      if (nl <= LEAST_COSINE || nv <= 0) continue;
      const fitted = mean(material.kd) + mean(material.ks) * lobe(nl, nv, nh, material.alpha);
      const value = codedValue(code) / nl, angle = degrees(Math.acos(clamp(nh, -1, 1)));
      found.push({ view, value, below, above, fitted, angle });
    }
    return found;
  }
}

/** The drawing of samples, as markup. */
function samplesPlotOf(samples) {
  const { width, height, left, right, top, bottom } = PLOT;
  const most = 1.1 * Math.max(...samples.map(({ value, fitted }) => Math.max(value, fitted)));
  const widest = Math.max(...samples.map(({ angle }) => angle), 10);
  const x = (angle) => (left + angle / widest * (width - left - right)).toFixed(1);
  const y = (value) => (height - bottom - clamp(value / most, 0, 1) * (height - top - bottom)).toFixed(1);
  const dots = (of) => samples.map((one) => `M${x(one.angle)} ${y(of(one))}h0`).join("");
  const bars = samples.filter(({ below }) => below !== null).map(({ angle, value, below, above }) => (
    `M${x(angle)} ${y(value * (1 - below))}V${y(value * (1 + above))}`
  ));
  const step = niceStep(most, 4), digits = Math.max(0, -Math.floor(Math.log10(step)));
  const levels = Array.from({ length: Math.floor(most / step) + 1 }, (_, k) => k * step);
  return `<svg viewBox="0 0 ${width} ${height}" role="img" class="samples"
    aria-label="Measured samples by the angle of the half vector to the normal, with bars of their 95 % intervals, and the fit">
    ${levels.map((value) => `<line class="grid" x1="${left}" x2="${width - right}" y1="${y(value)}" y2="${y(value)}"/>
      <text x="${left - 4}" y="${Number(y(value)) + 3}" text-anchor="end">${value.toFixed(digits)}</text>`).join("")}
    <path class="bars" d="${bars.join("")}"/><path class="measured" d="${dots(({ value }) => value)}"/>
    <path class="fitted" d="${dots(({ fitted }) => fitted)}"/>
    <text x="${left}" y="${height - 16}">0°</text>
    <text x="${width - right}" y="${height - 16}" text-anchor="end">${widest.toFixed(0)}°</text>
    <text x="${(left + width) / 2}" y="${height - 3}" text-anchor="middle">half vector to normal</text></svg>`;
}

/** What bars are, and how long a typical one is. */
function barsTold(samples) {
  const known = samples.filter(({ below }) => below !== null);
  if (!known.length) return "Their uncertainty is not known.";
  const ends = ["below", "above"].map((side) => known.map((one) => one[side]).sort((one, other) => one - other));
  const [below, above] = ends.map((sorted) => percent(sorted[sorted.length >> 1]));
  return `Bars: 95 % intervals by all sources (noise, pixels' responses, inter-reflection that was subtracted,
    places that pixels see, power of each LED and of all, the mesh's vertices, places of LEDs), as if the errors of the
    channels were fully correlated; in the median ${below} below, ${above} above. Errors that samples share move them
    together.`;
}

/** What is told of samples, as markup. */
function samplesTold(samples) {
  if (!samples.length) return `<p class="small">None of its samples can be used.</p>`;
  const views = [...new Set(samples.map(({ view }) => view))].map(escaped).join(", ");
  const off = samples.map(({ value, fitted }) => Math.abs(fitted - value)).sort((one, other) => one - other);
  const told = percent(off[off.length >> 1] / mean(samples.map(({ value }) => value)));
  return `${samplesPlotOf(samples)}<p class="small">${samples.length} measured samples of ${views}: f,
    1/sr, mean of the channels. ${barsTold(samples)} Orange: the prediction of the fit for the
    same directions; median difference ${told} of the samples' mean.</p>`;
}
