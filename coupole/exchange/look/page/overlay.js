// What lies over the picture: scale bar, ruler, notes, legend.

const BAR_PX = 140;

/** A round length that is at most `BAR_PX` long where the camera looks, and how long that is. */
function scaleBar(camera, shorter) {
  const unit = 2 * halfFieldOf(camera) * camera.distance / shorter;
  const most = BAR_PX * unit, power = 10 ** Math.floor(Math.log10(most));
  const size = power * [5, 2, 1].find((factor) => factor * power <= most);
  return { size, pixels: size / unit };
}

function lengthText(size) {
  if (ABOUT.picture_px) return `${Number(size.toPrecision(4))} px`;
  return size < 1 ? `${Number((1000 * size).toPrecision(3))} µm` : `${Number(size.toPrecision(4))} mm`;
}

function drawScale(element, camera, shorter) {
  const { size, pixels } = scaleBar(camera, shorter);
  element.style.width = `${pixels}px`;
  element.textContent = lengthText(size);
}

/** Pins of notes and the ruler's line, as markup of an SVG whose unit is a pixel of the page. */
function marksOf(camera, width, height, notes, ruler) {
  const at = (place) => projected(camera, width, height, place);
  const pins = notes.map((note, number) => {
    const here = at(note.place);
    return here && `<g transform="translate(${here[0]} ${here[1]})"><circle r="10"/><text y="4">${
      number + 1}</text></g>`;
  });
  const ends = ruler.map(({ place }) => at(place));
  const dots = ends.map((here) => here && `<circle class="end" cx="${here[0]}" cy="${here[1]}" r="4"/>`);
  if (ends.length === 2 && ends[0] && ends[1]) {
    const [[x, y], [u, v]] = ends;
    dots.push(`<line x1="${x}" y1="${y}" x2="${u}" y2="${v}"/><text class="length" x="${(x + u) / 2}"
      y="${(y + v) / 2 - 8}">${measuredText(measuredLength(ABOUT, ruler))}</text>`);
  }
  return [...pins, ...dots].filter(Boolean).join("");
}

/** A cross in the middle of the picture, where keys point to, as markup. */
const aimOf = (width, height) => `<path class="aim" d="M${width / 2 - 9} ${height / 2}h18m-9 -9v18"/>`;

function legendOf(mode, quantity) {
  const { from, to, logarithmic, unit: told } = rangeOf(mode, quantity);
  const factor = told === "%" ? 100 : told === "degrees" ? 180 / Math.PI : 1;
  const middle = logarithmic ? Math.sqrt(from * to) : (from + to) / 2;
  const [low, mid, high] = [from, middle, to].map((value) => Number((value * factor).toPrecision(2)));
  return `<span class="ramp" style="background:linear-gradient(to right,${RAMP.join(",")})"></span>
    <span class="ends"><span>${low}</span><span>${mid}</span><span>${high} ${told}</span></span>`;
}

/** What has to be said of the colours of lights. */
function coloursTold(about, state) {
  const isTinted = (light) => light.illuminant || light.kelvin !== NEUTRAL_KELVIN;
  if (!state.lights.some(isTinted)) {
    return state.sky > 0 || state.environment > 0 ? ["colour of sky and surroundings are hypotheses in RGB"] : [];
  }
  const eye = state.adapted ? "eye adapted to the chosen light (Bradford)" : "no adaptation of the eye";
  return [`colours of lights are hypotheses in RGB, ${eye}`];
}

/** What has to be said of the picture, wherever it is seen; `compared` is the measured frame in it, `left` what is
 * said of the residual. */
function bannerOf(about, state, compared, left) {
  const kinds = { true: "Simulated object", false: "Measured object", null: "Pictures of an object" };
  const told = [kinds[about.simulated]];
  if (about.told?.["So far"]) told.push(about.told["So far"]);
  if (isLit(state.mode)) {
    told.push(`light computed from a fit (${[about.fit, ...left].join(", ")})`);
    if (about.environment && state.environment > 0) told.push(`surroundings ${about.environment.name}`);
    told.push(...coloursTold(about, state));
  }
  if (isStereo(state)) told.push("for two eyes: the left eye's picture is on the left");
  if (state.beside === "state") told.push(`left: ${about.beside.name}, ${about.beside.fit}`);
  if (state.beside === "light") told.push("left: another light");
  if (state.mode === "unsharp") told.push("relief exaggerated");
  if (compared?.texture && isLit(state.mode)) told.push(`left: measured frame under LED ${compared.frame.led}`);
  return told.join(" · ");
}
