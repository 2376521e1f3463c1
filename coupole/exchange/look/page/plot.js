// Reflectance of a point by the light's angle, as SVG: the channels, and the bounds of their mean.

const PLOT = { width: 280, height: 170, left: 40, right: 8, top: 8, bottom: 30, reach: 85 };
const CHANNELS = ["#ff8a7a", "#7fd491", "#8ab6ff"];

function niceStep(span, parts) {
  const rough = span / parts, power = 10 ** Math.floor(Math.log10(rough));
  return power * [1, 2, 5, 10].find((factor) => factor * power >= rough);
}

/** The drawing, as markup. `view` is the camera's angle to the normal, degrees. */
function plotOf(material, view) {
  const angles = Array.from({ length: 2 * PLOT.reach / 2.5 + 1 }, (_, k) => -PLOT.reach + 2.5 * k);
  const curves = [0, 1, 2].map((k) => angles.map(
    (light) => reflectance(material.kd[k], material.ks[k], material.alpha, view, light),
  ));
  const bounds = angles.map((light) => reflectanceBounds(material, view, light));
  const top = 1.35 * Math.max(...curves.flat(), 1e-6);
  const x = (light) => PLOT.left + (light + PLOT.reach) / (2 * PLOT.reach) * (PLOT.width - PLOT.left - PLOT.right);
  const y = (value) => PLOT.height - PLOT.bottom
    - Math.min(value / top, 1) * (PLOT.height - PLOT.top - PLOT.bottom);
  const line = (values) => values.map((value, k) => `${x(angles[k]).toFixed(1)},${y(value).toFixed(1)}`);
  const band = [...line(bounds.map(([low]) => low)), ...line(bounds.map(([, high]) => high)).reverse()];
  const step = niceStep(top, 4), digits = Math.max(0, -Math.floor(Math.log10(step)));
  const levels = Array.from({ length: Math.floor(top / step) + 1 }, (_, k) => k * step);
  return `<svg viewBox="0 0 ${PLOT.width} ${PLOT.height}" role="img"
    aria-label="Reflectance by the light's angle, with 95 % bounds">
    ${levels.map((value) => `<line class="grid" x1="${PLOT.left}" x2="${PLOT.width - PLOT.right}"
      y1="${y(value)}" y2="${y(value)}"/><text x="${PLOT.left - 4}" y="${y(value) + 3}" text-anchor="end">${
        value.toFixed(digits)}</text>`).join("")}
    ${[-60, 0, 60].map((light) => `<text x="${x(light)}" y="${PLOT.height - 16}" text-anchor="middle">${
      light}°</text>`).join("")}
    <line class="mirror" x1="${x(view)}" x2="${x(view)}" y1="${PLOT.top}" y2="${PLOT.height - PLOT.bottom}"/>
    ${material.uncertainty.kd === null ? "" : `<polygon class="band" points="${band.join(" ")}"/>`}
    ${curves.map((values, k) => `<polyline stroke="${CHANNELS[k]}" points="${line(values).join(" ")}"/>`).join("")}
    <text x="${(PLOT.left + PLOT.width) / 2}" y="${PLOT.height - 3}" text-anchor="middle">angle of the light</text>
  </svg>`;
}

const percent = (share) => share === null ? "unknown" : share > 1 ? "over 100 %" : `${
  Number((100 * share).toPrecision(2))} %`;
const three = (values) => values.map((value) => value.toPrecision(3)).join(" / ");

/** What is told of a point, as markup. */
function toldOf(triangle, place, material, view) {
  const at = ABOUT.picture_px
    ? `Pixel ${Math.floor(place[0])}, ${Math.floor(ABOUT.picture_px[1] - place[1])}`
    : `Triangle ${triangle} at ${place.map((value) => value.toFixed(2)).join(", ")} mm`;
  if (!material) return `<p>${at}: it was seen in too few frames, so it has no material.</p>`;
  const { kd, ks, normal, roughness } = material.uncertainty;
  const bounds = kd === null ? "No uncertainty is known." : "Band: 95 % interval of their mean.";
  const angle = normal === null ? "unknown" : `${degrees(normal).toPrecision(2)}°`;
  const row = (name, value, u) => `<tr><th scope="row">${name}</th><td>${value}</td><td>± ${u}</td></tr>`;
  return `<p>${at}</p>${plotOf(material, view)}
    <p class="small">${ABOUT.unit}; red, green, blue. ${bounds} Dotted: direction of mirror reflection to the camera. Drawn from
    the fitted coefficients${ABOUT.samples ? "" : "; this page holds no samples"}.</p>
    <div id="samples-told" role="status"></div>
    <table><tbody>
    ${row("Diffuse kd", three(material.kd), percent(kd))}
    ${row("Highlight ks", three(material.ks), percent(ks))}
    ${row("Roughness α", material.alpha.toPrecision(3), percent(roughness))}
    ${row("Normal", material.normal.map((value) => value.toFixed(3)).join(", "), angle)}
    ${material.residual === null ? "" : `<tr><th scope="row">Residual of the fit</th><td colspan="2">${
      percent(material.residual)} of √kd</td></tr>`}
    </tbody></table>`;
}
