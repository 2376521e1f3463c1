"""Checkers of others' formats that run outside the project's environment; `prepare_tests` of tools/bootstrap.sh
installs them."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest
from places import REPO

HOME = REPO / ".tools/checkers"
PATIENCE_S = 60
CHECKERS_FAILED = "checkers of exported files could not be installed"
_REASON = CHECKERS_FAILED if (REPO / ".tools/tried-checkers").exists() else "tools/test installs checkers first"
needs_checkers = pytest.mark.skipif(not (HOME / "stamp").exists(), reason=_REASON)

_OF_GLTF = """
require("gltf-validator").validateBytes(new Uint8Array(require("fs").readFileSync(process.argv[1])))
  .then(({ issues }) => console.log(JSON.stringify(issues)));
"""
_OF_KTX2 = """
import(process.argv[2]).then(({ read }) => {
  const file = read(new Uint8Array(require("fs").readFileSync(process.argv[1])));
  const { vkFormat, pixelWidth, pixelHeight, supercompressionScheme, dataFormatDescriptor, keyValue } = file;
  const levels = file.levels.map((one) => [
    Buffer.from(one.levelData).toString("base64"), one.uncompressedByteLength ]);
  const text = (value) => typeof value === "string" ? value : Buffer.from(value).toString().replace(/\\0$/, "");
  const notes = Object.fromEntries(Object.entries(keyValue).map(([key, value]) => [key, text(value)]));
  console.log(JSON.stringify({
    vkFormat, pixelWidth, pixelHeight, supercompressionScheme, dataFormatDescriptor, levels, notes }));
});
"""
_KEEP_CONTEXT = """
import sys
from io import BytesIO
from pathlib import Path
from requests import Request
from requests.models import Response
from requests_cache import CachedSession
from urllib3 import HTTPResponse

cache, url, file = sys.argv[1:]
body, session = Path(file).read_bytes(), CachedSession(cache)
answer = Response()
answer.status_code, answer.url, answer._content = 200, url, body
answer.request = session.prepare_request(Request("GET", url))
answer.headers["Content-Type"] = "application/ld+json"
answer.raw = HTTPResponse(body=BytesIO(body), status=200, headers=answer.headers)
session.cache.save_response(answer)
"""
"""Puts an answer into the cache from which roc-validator takes what it would ask the network for."""


def _run(*words: str | Path, **more: str) -> str:
    ended = subprocess.run(
        [str(word) for word in words],
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        env=os.environ | more,
        check=False,
    )
    assert ended.returncode in {0, 1}, ended.stderr
    return ended.stdout


def gltf_messages(path: Path) -> list[str]:
    """Errors and warnings of the Khronos group's gltf-validator."""
    node = shutil.which("node") or HOME / "bin/node"
    found = json.loads(_run(node, "-e", _OF_GLTF, path, NODE_PATH=str(HOME / "node/node_modules")))
    assert not found["truncated"]
    return [f"{one['code']} {one['message']}" for one in found["messages"] if one["severity"] < 2]


def ktx2_contents(path: Path) -> dict[str, Any]:
    """Contents of a KTX 2.0 file as ktx-parse reads it; levels are pairs of their data, as in the file (base64),
    and the size of what that holds."""
    node = shutil.which("node") or HOME / "bin/node"
    module = (HOME / "node/node_modules/ktx-parse/dist/index.mjs").as_uri()
    contents: dict[str, Any] = json.loads(_run(node, "-e", _OF_KTX2, path, module))
    return contents


_OF_ANNOTATIONS = """
const { items, ...page } = JSON.parse(require("fs").readFileSync(0, "utf8"));
const isValid = require("validate-web-annotation");
const each = items.map(({ created, ...item }) => ({ "@context": page["@context"], ...item }));
console.log(JSON.stringify(each.filter((item) => !isValid(item)).map(({ id }) => id)));
"""


def annotation_faults(page: dict[str, Any]) -> list[str]:
    """Ids of the annotations of a W3C AnnotationPage that validate-web-annotation refuses, each with the page's
    context; without `created`, for which it wants a day where the data model has a time."""
    node = shutil.which("node") or HOME / "bin/node"
    environment = os.environ | {"NODE_PATH": str(HOME / "node/node_modules")}
    told = subprocess.run(
        [str(node), "-e", _OF_ANNOTATIONS],
        input=json.dumps(page),
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        env=environment,
        check=True,
    )
    faults: list[str] = json.loads(told.stdout)
    return faults


def crate_issues(crate: Path, aside: Path, severity: str = "required") -> list[str]:
    """What the RO-Crate community's roc-validator misses of RO-Crate 1.1, of a severity and above. Without a
    network: the context is the one that ro-crate-py brings, of 1.3, which has all terms of 1.1."""
    import rocrate

    context = Path(rocrate.__file__).parent / "data/ro-crate.jsonld"
    url = json.loads((crate / "ro-crate-metadata.json").read_text())["@context"]
    cache = aside / "http"
    if not cache.with_suffix(".sqlite").exists():
        _run(HOME / "bin/python", "-c", _KEEP_CONTEXT, cache, url, context)
    words: list[str | Path] = ["-y", "validate", "-p", "ro-crate-1.1", "-l", severity, "--offline", "-f", "json"]
    words += ["--cache-path", cache, "-o", aside / "report.json", crate]
    _run(HOME / "bin/rocrate-validator", *words)
    report: dict[str, Any] = json.loads((aside / "report.json").read_text())
    issues = [f"{one['severity']}: {one['message']}" for one in report["issues"]]
    assert report["passed"] == (not issues)
    return issues
