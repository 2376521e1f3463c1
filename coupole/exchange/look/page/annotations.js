// Notes as W3C Web Annotations (Web Annotation Data Model, 2017) in JSON-LD, and back.

const VOCABULARY = ["http:", "", "www.w3.org", "ns", "anno.jsonld"].join("/");  // a name: nothing is fetched from there
const TERMS = "urn:x-coupole:terms#";
const SHOWN_BY = `${TERMS}shownBy`;  // view and lights of a note
const OF_A_POINT = `${TERMS}point`;
const NOTE_LETTERS = 4000;
const OFF_SURFACE = 0.01;  // of the object's radius: a note that is farther from the surface is of something else

const lengthUnitOf = (about) => about.picture_px ? "px" : "mm";

/** A name of the object that stays the same as long as its mesh does. */
const sourceOf = (about) => `urn:x-coupole:object:${about.mesh_sha256 ?? encodeURIComponent(about.title)}`;

/** A random UUID (RFC 9562, version 4) as an IRI. */
function newId() {
  const bytes = crypto.getRandomValues(new Uint8Array(16));
  bytes[6] = bytes[6] & 15 | 64;
  bytes[8] = bytes[8] & 63 | 128;
  const digits = [...bytes].map((byte) => byte.toString(16).padStart(2, "0")).join("");
  return `urn:uuid:${[[0, 8], [8, 12], [12, 16], [16, 20], [20, 32]].map((ends) => digits.slice(...ends)).join("-")}`;
}

function annotationOf(about, { id, created, by, text, place, camera, lights }) {
  const [x, y, z] = place.map((value) => Number(value.toFixed(4)));
  return {
    id, type: "Annotation", motivation: "commenting", created,
    ...by && { creator: { type: "Person", name: by } },
    generator: { id: "urn:x-coupole:software", type: "Software", name: `Coupole ${about.software.coupole ?? ""}`.trim() },
    body: { type: "TextualBody", value: text, format: "text/plain", purpose: "commenting" },
    target: {
      type: "SpecificResource", source: sourceOf(about),
      selector: [
        { type: "FragmentSelector", conformsTo: OF_A_POINT, value: `${lengthUnitOf(about)}=${x},${y},${z}` },
        { type: "PointSelector", x, y, z },
      ],
      [SHOWN_BY]: { camera, lights },
    },
  };
}

/** All notes as the text of a file: an AnnotationPage. */
function annotationsText(about, notes) {
  const page = {
    "@context": VOCABULARY, id: newId(), type: "AnnotationPage",
    items: notes.map((note) => annotationOf(about, note)),
  };
  return `${JSON.stringify(page, null, 2)}\n`;
}

const listOf = (value) => value === undefined ? [] : Array.isArray(value) ? value : [value];
const isOfType = (thing, type) => listOf(thing?.type ?? thing?.["@type"]).includes(type);

/** The point of a selector; null if it names none. */
function pointOf(selector, unit) {
  if (isOfType(selector, "PointSelector")) {
    const point = [selector.x, selector.y, selector.z ?? 0];
    return isVector(point) ? point : null;
  }
  const found = isOfType(selector, "FragmentSelector") && selector.conformsTo === OF_A_POINT
    && new RegExp(`^${unit}=([^,]+),([^,]+),([^,]+)$`).exec(selector.value);
  const point = found ? found.slice(1).map(Number) : null;
  return isVector(point) ? point : null;
}

/** The note of an annotation. Raises an Error that says what was expected; `here` is what is shown at present. */
function noteOf(about, annotation, here) {
  if (!isOfType(annotation, "Annotation")) throw new Error("type: expected Annotation");
  const bodies = listOf(annotation.body).filter((body) => isOfType(body, "TextualBody"));
  const text = bodies.length ? bodies.map(({ value }) => value).join(" ") : annotation.bodyValue;
  if (typeof text !== "string" || !text.trim()) throw new Error("body: expected a TextualBody with words in its value");
  if (text.length > NOTE_LETTERS) throw new Error(`body: expected at most ${NOTE_LETTERS} letters, got ${text.length}`);
  const [target] = listOf(annotation.target), unit = lengthUnitOf(about);
  const points = listOf(target?.selector).map((selector) => pointOf(selector, unit));
  const place = points.find(Boolean);
  if (!place) throw new Error(`target.selector: expected a PointSelector with x, y, z in ${unit}, or a FragmentSelector "${unit}=x,y,z"`);
  const { camera, lights } = target[SHOWN_BY] ?? {};
  const note = {
    text: text.trim(), place, camera: camera ?? here.camera, lights: lights ?? here.lights,
    id: annotation.id ?? newId(), created: annotation.created ?? new Date().toISOString(),
    by: listOf(annotation.creator)[0]?.name ?? "",
  };
  if (!isNote(note)) throw new Error(`target.${SHOWN_BY}: expected camera and lights as this page writes them`);
  return note;
}

/** Notes of a file's text. Raises an Error with line and expectation. `distanceTo(place)` is how far a place is from the
 * surface, `reach` how far it may be. */
function notesOf(about, text, here, distanceTo, reach) {
  const found = parsed(text);
  const items = Array.isArray(found) ? found : isOfType(found, "AnnotationPage") ? found.items : [found];
  if (!Array.isArray(items)) throw new Error("line 1: items: expected a list of annotations");
  if (!items.length) throw new Error("line 1: expected at least one annotation, got none");
  return items.map((item, number) => {
    const where = `line ${lineOfItem(text, number)}: annotation ${number + 1}`;
    let note;
    try {
      note = noteOf(about, item, here);
    } catch (error) {
      throw new Error(`${where}, ${error.message}`);
    }
    const off = distanceTo(note.place), unit = lengthUnitOf(about);
    if (off > reach) {
      throw new Error(`${where} lies ${Number(off.toPrecision(3))} ${unit} off this surface: expected notes of this object`);
    }
    return note;
  });
}

function parsed(text) {
  try {
    return JSON.parse(text);
  } catch (error) {
    const before = text.slice(0, firstFault(text));
    const line = before.split("\n").length, column = before.length - before.lastIndexOf("\n");
    throw new Error(`line ${line}, column ${column}: expected JSON of W3C Web Annotations`);
  }
}

const JSON_TOKEN = /\s*(?:("(?:[^"\\\u0000-\u001f]|\\(?:["\\/bfnrt]|u[0-9a-fA-F]{4}))*"|-?(?:0|[1-9]\d*)(?:\.\d+)?(?:[eE][+-]?\d+)?|true|false|null)|([{}[\],:]))/y;

/** Where text stops being JSON: browsers do not all tell. */
function firstFault(text) {
  const open = [], skipped = (at) => at + /^\s*/.exec(text.slice(at))[0].length;
  let awaited = ["value"], end = 0;
  while (true) {
    JSON_TOKEN.lastIndex = end;
    const found = JSON_TOKEN.exec(text);
    const kind = found && (found[2] ?? (found[1].startsWith('"') && awaited.includes("key") ? "key" : "value"));
    const isBegin = kind === "{" || kind === "[", wanted = isBegin ? "value" : kind;
    if (!found || !awaited.includes(wanted)) return skipped(end);
    end = JSON_TOKEN.lastIndex;
    if (isBegin) open.push(kind);
    if (kind === "}" || kind === "]") open.pop();
    const inside = open.at(-1), closing = inside === "{" ? "}" : "]";
    if (kind === "{") awaited = ["key", "}"];
    else if (kind === "[") awaited = ["value", "]"];
    else if (kind === "key") awaited = [":"];
    else if (kind === ":") awaited = ["value"];
    else if (kind === ",") awaited = [inside === "{" ? "key" : "value"];
    else awaited = inside ? [",", closing] : [];
  }
}

/** The line on which an annotation begins: of a page's items, of a list, or the first. */
function lineOfItem(text, wanted) {
  const tokens = /"(?:[^"\\]|\\.)*"\s*(:)?|[{}[\]]/g, isList = text.trimStart().startsWith("[");
  let depth = 0, key = "", number = 0;
  for (let found = tokens.exec(text); found; found = tokens.exec(text)) {
    const [token, colon] = found;
    if (colon && depth === 1) key = token.slice(1, token.lastIndexOf('"'));
    if (token === "{" && (isList ? depth === 1 : depth === 2 && key === "items") && number++ === wanted) {
      return text.slice(0, found.index).split("\n").length;
    }
    if ("{[".includes(token)) depth += 1;
    else if ("}]".includes(token)) depth -= 1;
  }
  return 1;
}

/** How far a place is from the nearest triangle, mm. */
function distanceToMesh({ places, triangles }, { origin_mm: origin, step_mm: step }, place) {
  const corner = (number) => add(origin, times([places[3 * number], places[3 * number + 1], places[3 * number + 2]], step));
  let least = Infinity;
  for (let k = 0; k < triangles.length; k += 3) {
    const first = corner(triangles[k]);
    least = Math.min(least, distanceToTriangle(place, first, corner(triangles[k + 1]), corner(triangles[k + 2])));
  }
  return least;
}

function distanceToTriangle(place, a, b, c) {
  const normal = unit(cross(minus(b, a), minus(c, a))), corners = [a, b, c];
  const isInside = corners.every((from, k) => {
    const to = corners[(k + 1) % 3];
    return dot(cross(minus(to, from), minus(place, from)), normal) >= 0;
  });
  if (isInside) return Math.abs(dot(minus(place, a), normal));
  return Math.min(...corners.map((from, k) => {
    const along = minus(corners[(k + 1) % 3], from), square = dot(along, along) || 1;
    const share = clamp(dot(minus(place, from), along) / square, 0, 1);
    return length(minus(place, add(from, times(along, share))));
  }));
}
