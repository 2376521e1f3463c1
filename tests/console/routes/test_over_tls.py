"""The console over TLS, as other machines reach it: they look, and whatever anybody sends, it does not fail.

Addresses of the loopback network stand for machines: who connects from the address to which he connects is on the
same one, who connects from another is not.
"""

from __future__ import annotations

import ssl
import subprocess
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest
from cells import CellFolder
from hypothesis import HealthCheck, Phase, given, settings
from served import Browser, served

HERE, ELSEWHERE = "127.0.0.9", "127.0.0.8"
ENDLESS_OR_OVER = ("/api/v1/events", "/api/v1/sign-out")
"""A stream, and the end of the session that asks."""
HASHES = ("/api/v1/sign-in", "/api/v1/accounts")
"""Each costs a hash that is made to cost."""
PASSWORD = "a long password"


@dataclass
class Reached:
    """A console with TLS, and its certificate."""

    url: str
    certificate: Path
    token: str

    def browser(self, address: str) -> Browser:
        trusted = ssl.create_default_context(cafile=str(self.certificate))
        return Browser(self.url, trusted=trusted, address=address)


@pytest.fixture(scope="module")
def console(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Reached]:
    folder = tmp_path_factory.mktemp("tls")
    certificate, key = folder / "certificate.pem", folder / "key.pem"
    curve = ["-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes"]
    asked = ["req", "-x509", *curve, "-days", "2", "-subj", "/CN=dome"]
    names = ["-addext", f"subjectAltName=IP:{HERE}", "-keyout", str(key), "-out", str(certificate)]
    subprocess.run(["openssl", *asked, *names], check=True, capture_output=True)
    options = ("--host", "0.0.0.0", "--name", HERE, "--tls-certificate", certificate, "--tls-key", key)
    with served(CellFolder(folder), *options) as service:
        yield Reached(f"https://{HERE}:{urlsplit(service.url).port}", certificate, service.token)


@pytest.fixture(scope="module")
def engineer(console: Reached) -> Browser:
    """Ida, whose account the first engineer has made, at the machine itself."""
    found = console.browser(HERE)
    session = found.sign_in(token=console.token, script=True).document["session"]
    found.headers = {"Authorization": f"Bearer {session}"}
    made = found.ask("POST", "/api/v1/accounts", {"name": "Ida", "password": PASSWORD, "role": "engineer"})
    assert made.status == 200, made.text
    assert found.get("/api/v1/state").status == 401, "who has the token is nobody's engineer any more"
    found.headers = {}
    session = found.sign_in(name="Ida", password=PASSWORD, script=True).document["session"]
    found.headers = {"Authorization": f"Bearer {session}"}
    return found


def test_the_first_token_is_good_at_the_machine_alone(console: Reached) -> None:
    assert console.browser(ELSEWHERE).sign_in(token=console.token).status == 401


def test_from_another_machine_everybody_only_looks(console: Reached, engineer: Browser) -> None:
    made = engineer.ask("POST", "/api/v1/accounts", {"name": "Ada", "password": PASSWORD, "role": "operator"})
    assert made.status == 200, made.text
    for name in ("Ada", "Ida"):
        somebody = console.browser(ELSEWHERE)
        signed_in = somebody.sign_in(name=name, password=PASSWORD)
        assert signed_in.status == 200
        assert "secure" in signed_in.headers["Set-Cookie"].lower()
        assert somebody.state()["state"] == "idle"
        for path, body in (
            ("queue", {"hold": "a word"}),
            ("control/take", None),
            ("cell/lease", {"what": "live"}),
        ):
            refused = somebody.post(f"/api/v1/{path}", body)
            assert (refused.status, f"{name} is observer" in refused.text) == (403, True), path
        assert somebody.get("/api/v1/accounts").status == 403
    at_the_machine = console.browser(HERE)
    at_the_machine.sign_in(name="Ada", password=PASSWORD)
    assert at_the_machine.post("/api/v1/control/take").document["name"] == "Ada"
    assert at_the_machine.post("/api/v1/control/give", {}).status == 200
    moved = console.browser(ELSEWHERE)
    moved.cookie = at_the_machine.cookie
    assert moved.post("/api/v1/control/take").status == 403, "the machine counts, not the session"


def test_nothing_is_said_without_tls_and_the_certificate_is_the_one_that_was_given(console: Reached) -> None:
    place = urlsplit(console.url)
    presented = ssl.get_server_certificate((HERE, place.port or 0))
    assert presented.split() == console.certificate.read_text().split()
    with pytest.raises(ConnectionError):
        Browser(f"http://{HERE}:{place.port}").get("/")
    other = Browser(f"https://127.0.0.1:{place.port}", trusted=console.browser(HERE).trusted)
    with pytest.raises(ssl.SSLCertVerificationError):
        other.get("/")


def _wrong(operation: Any) -> Any:
    """Requests that the schema forbids; there are none where it says nothing of what is sent."""
    import schemathesis

    if operation.body.items or operation.path_parameters.items:
        return operation.as_strategy(generation_mode=schemathesis.GenerationMode.NEGATIVE)
    return operation.as_strategy()


def test_no_request_that_the_schema_allows_or_forbids_makes_it_fail(
    console: Reached, engineer: Browser, scale: Callable[[int, int], int]
) -> None:
    import schemathesis

    document = engineer.get("/openapi.json").document
    counted: dict[str, int] = {}
    for found in schemathesis.openapi.from_dict(document).get_all_operations():
        operation = found.ok()
        if operation.path in ENDLESS_OR_OVER:
            continue
        examples = 2 if operation.path in HASHES else scale(4, 100)

        @settings(
            max_examples=examples, deadline=None, database=None, derandomize=True, phases=[Phase.generate],
            suppress_health_check=list(HealthCheck),
        )  # fmt: skip
        @given(case=operation.as_strategy() | _wrong(operation))
        def ask(case: Any) -> None:
            headers = {**engineer.headers, "Connection": "close"}
            reply = case.call(base_url=console.url, headers=headers, verify=str(console.certificate))
            counted[case.operation.label] = counted.get(case.operation.label, 0) + 1
            assert reply.status_code < 500, f"{case.as_curl_command()}: {reply.text}"

        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            ask()
    assert len(counted) >= 20
    assert sum(counted.values()) > 80
