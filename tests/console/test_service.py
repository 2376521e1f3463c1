"""`coupole serve`: who is let in and what they may do, and that no fault of it touches a run."""

from __future__ import annotations

import http.client
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import cells
import pytest
from cells import CellFolder
from served import Browser, Served, served

from coupole.acquisition.runtime_folder import runtime_folder

PASSWORD = "a long password"


@dataclass
class Staffed:
    """A console with an engineer and two operators, and an observer."""

    cell: CellFolder
    served: Served
    engineer: Browser

    def signed_in(self, name: str) -> Browser:
        return self.served.browser(name=name, password=PASSWORD)

    def audit(self) -> list[dict[str, Any]]:
        lines = (self.cell.folder / "storage/state/console/audit.jsonl").read_text().splitlines()
        return [json.loads(line) for line in lines]


@pytest.fixture(scope="module")
def staffed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Staffed]:
    cell = CellFolder(tmp_path_factory.mktemp("served"))
    with served(cell) as service:
        engineer = service.browser(token=service.token)
        for name, role in (("Ada", "operator"), ("Max", "operator"), ("Eve", "observer")):
            made = engineer.post("/api/v1/accounts", {"name": name, "password": PASSWORD, "role": role})
            assert made.status == 200, made.text
        yield Staffed(cell, service, engineer)


@pytest.fixture(autouse=True)
def nobody_in_control(request: pytest.FixtureRequest) -> Iterator[None]:
    yield
    if "staffed" in request.fixturenames:
        engineer: Browser = request.getfixturevalue("staffed").engineer
        engineer.post("/api/v1/control/take")
        assert engineer.post("/api/v1/control/give", {}).status == 200


# -- who is let in --------------------------------------------------------------------------------------------


def test_without_sign_in_only_the_page_to_sign_in_is_served(staffed: Staffed) -> None:
    nobody = staffed.served.browser()
    page = nobody.get("/")
    assert page.status == 200
    assert "Sign in" in page.text
    assert staffed.cell.rig_data["name"] not in page.text
    schema = staffed.engineer.get("/openapi.json").document
    operations = [(method, path) for path, ways in schema["paths"].items() for method in ways]
    assert len(operations) > 10
    for method, path in [*operations, ("get", "/openapi.json"), ("get", "/docs"), ("get", "/nowhere")]:
        if path != "/api/v1/sign-in":
            assert nobody.ask(method.upper(), path, {}).status == 401, path


def test_the_token_of_the_first_start_is_good_for_once(staffed: Staffed) -> None:
    assert len(staffed.served.token) > 20
    assert staffed.served.browser().sign_in(token=staffed.served.token).status == 401
    assert staffed.served.browser().sign_in(token="").status == 401


def test_a_wrong_password_is_refused_and_after_five_the_right_one_too(staffed: Staffed) -> None:
    somebody = staffed.served.browser()
    for password in ("", "wrong", "a long passwore", PASSWORD[:-1], PASSWORD + " "):
        assert somebody.sign_in(name="Nobody", password=password).status == 401
    made = staffed.engineer.post("/api/v1/accounts", {"name": "Nobody", "password": PASSWORD, "role": "operator"})
    assert made.status == 200
    assert somebody.sign_in(name="Nobody", password=PASSWORD).status == 401
    assert staffed.signed_in("Eve").state()["state"] == "idle", "others are not kept out"


def test_cookies_are_kept_from_scripts_and_other_sites_and_answers_from_caches(staffed: Staffed) -> None:
    reply = staffed.served.browser().sign_in(name="Eve", password=PASSWORD)
    cookie = reply.headers["Set-Cookie"].lower()
    assert "httponly" in cookie
    assert "samesite=strict" in cookie
    assert reply.headers["Cache-Control"] == "no-store"
    assert reply.headers["X-Frame-Options"] == "DENY"
    kept = (staffed.cell.folder / "storage/state/console/accounts.json").read_text()
    assert PASSWORD not in kept
    assert kept.count("$argon2id$") >= 3
    assert (staffed.cell.folder / "storage/state/console/accounts.json").stat().st_mode & 0o077 == 0


def test_a_script_has_a_bearer_and_a_cookie_is_none(staffed: Staffed) -> None:
    script = staffed.served.browser()
    session = script.sign_in(name="Ada", password=PASSWORD, script=True).document["session"]
    assert script.cookie == ""
    script.headers = {"Authorization": f"Bearer {session}"}
    assert script.ask("POST", "/api/v1/control/take").document["name"] == "Ada"
    ada = staffed.signed_in("Ada")
    stolen = staffed.served.browser()
    stolen.headers = {"Authorization": f"Bearer {ada.cookie.partition('=')[2]}"}
    assert stolen.get("/api/v1/state").status == 401
    stolen.headers, stolen.cookie = {}, f"{ada.cookie.partition('=')[0]}={session}"
    assert stolen.get("/api/v1/state").status == 401


def test_the_event_stream_tells_the_state_and_ends_with_its_session(staffed: Staffed) -> None:
    eve = staffed.signed_in("Eve")
    place = urlsplit(eve.url)
    connection = http.client.HTTPConnection(place.hostname or "", place.port, timeout=cells.PATIENCE_S)
    connection.request("GET", "/api/v1/events", headers={"Cookie": eve.cookie})
    stream = connection.getresponse()
    assert stream.headers["Content-Type"].startswith("text/event-stream")
    assert stream.readline() == b"event: state\n"
    assert json.loads(stream.readline().removeprefix(b"data: "))["state"] == "idle"
    assert eve.post("/api/v1/sign-out").status == 200
    stream.read()
    connection.close()


def test_a_body_that_is_too_large_is_not_read(staffed: Staffed) -> None:
    somebody = staffed.served.browser()
    assert somebody.sign_in(name="Eve", password="x" * 100_000).status == 413
    assert somebody.ask("POST", "/api/v1/sign-in", **{"Transfer-Encoding": "chunked"}).status == 411


def test_a_session_that_has_signed_out_and_those_of_a_removed_account_are_over(staffed: Staffed) -> None:
    eve = staffed.signed_in("Eve")
    assert eve.post("/api/v1/sign-out").status == 200
    assert eve.get("/api/v1/state").status == 401
    staffed.engineer.post("/api/v1/accounts", {"name": "Tom", "password": PASSWORD, "role": "operator"})
    tom = staffed.signed_in("Tom")
    assert staffed.engineer.post("/api/v1/accounts/Tom", method="DELETE").status == 200
    assert tom.get("/api/v1/state").status == 401


def test_numbers_that_no_lamp_gives_are_refused_and_logged(staffed: Staffed) -> None:
    """NaN had ended in an internal error that no log told of; true had been one lux hour."""
    ada = staffed.signed_in("Ada")
    for value in (float("nan"), float("inf"), -1, True, "5", 1e30):
        for what, more in (("light", {"note": "x"}), ("budget", {})):
            path = f"/api/v1/objects/relief/{what}"
            assert ada.post(path, {"dose_lux_h": value, **more}).status == 422, (what, value)
            last = staffed.audit()[-1]
            assert (last["name"], last["asked"], last["status"]) == ("Ada", f"POST {path}", 422)
    assert ada.get("/api/v1/objects/relief/light").document["dose_lux_h"] == 0


def test_no_two_accounts_look_alike(staffed: Staffed) -> None:
    for name in ("ada", "ADA", "Ada ", "\uff21da"):
        wanted = {"name": name, "password": PASSWORD, "role": "observer"}
        assert staffed.engineer.post("/api/v1/accounts", wanted).status == 422, name


# -- requests that are forged ---------------------------------------------------------------------------------


def test_a_form_without_a_token_with_a_wrong_one_or_replayed_changes_nothing(staffed: Staffed) -> None:
    ada, max_ = staffed.signed_in("Ada"), staffed.signed_in("Max")
    hold = {"hold": "forged"}
    assert ada.ask("POST", "/api/v1/queue", hold).status == 403
    assert ada.ask("POST", "/api/v1/queue", hold, **{"X-Coupole-Token": "x"}).status == 403
    assert ada.ask("POST", "/api/v1/queue", hold, **{"X-Coupole-Token": max_.token()}).status == 403
    once = {"X-Coupole-Token": ada.token()}
    assert ada.ask("POST", "/api/v1/control/take", **once).status == 200
    assert ada.ask("POST", "/api/v1/control/take", **once).status == 403
    assert ada.state()["queue"] == []


@pytest.mark.parametrize("origin", ["https://evil.example", "http://127.0.0.1:1", "null"])
def test_the_page_of_another_site_is_refused(staffed: Staffed, origin: str) -> None:
    ada = staffed.signed_in("Ada")
    token = ada.token()
    refused = ada.ask("POST", "/api/v1/control/take", Origin=origin, **{"X-Coupole-Token": token})
    assert refused.status == 403
    assert ada.get("/api/v1/state", Origin=origin).status == 403
    assert ada.get("/api/v1/state", Origin=staffed.served.url).status == 200


def test_a_name_that_another_site_has_pointed_here_is_refused(staffed: Staffed) -> None:
    assert staffed.engineer.get("/api/v1/state", Host="evil.example").status == 400
    assert staffed.served.browser().get("/", Host="evil.example").status == 400


# -- what they may do -----------------------------------------------------------------------------------------


def test_screens_work_only_with_a_session_and_from_the_consoles_own_pages(staffed: Staffed) -> None:
    url, upgrade = staffed.served.url, {"Connection": "Upgrade", "Upgrade": "websocket"}
    upgrade |= {"Sec-WebSocket-Version": "13", "Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ=="}
    asked = "/_nicegui_ws/socket.io/?EIO=4&transport=websocket"
    ada, nobody = staffed.signed_in("Ada"), staffed.served.browser()
    assert ada.get(asked, Origin=url, **upgrade).status == 101
    assert ada.get(asked, Origin="https://evil.example", **upgrade).status == 403
    assert ada.get(asked, **upgrade).status == 403
    assert nobody.get(asked, Origin=url, **upgrade).status == 403
    assert nobody.get("/_nicegui_ws/socket.io/?EIO=4&transport=polling").status == 401
    page = ada.get("/run", Accept="text/html")
    assert page.status == 200
    assert "default-src 'self'" in page.headers["Content-Security-Policy"]
    asked_for = nobody.get("/run", Accept="text/html")
    assert asked_for.status == 401
    assert "Sign in" in asked_for.text


def test_an_observer_looks_and_changes_nothing(staffed: Staffed) -> None:
    eve = staffed.signed_in("Eve")
    assert eve.state()["simulated"] is True
    for path, body in (
        ("/api/v1/queue", {"hold": "a word"}),
        ("/api/v1/queue/go-on", None),
        ("/api/v1/control/take", None),
        ("/api/v1/runs/any/stop", None),
        ("/api/v1/accounts", {"name": "Mal", "password": PASSWORD, "role": "engineer"}),
    ):
        refused = eve.post(path, body)
        assert refused.status == 403, path
        assert "Eve is observer" in refused.document["detail"]
    assert eve.get("/api/v1/accounts").status == 403
    last = staffed.audit()[-1]
    assert (last["name"], last["asked"], last["status"]) == ("Eve", "POST /api/v1/accounts", 403)


def test_one_is_in_control_another_looks_until_it_is_handed_over(staffed: Staffed) -> None:
    ada, max_ = staffed.signed_in("Ada"), staffed.signed_in("Max")
    added = ada.post("/api/v1/queue", {"hold": "clean the glass"})
    assert added.status == 200
    assert ada.state()["in_control"] == "Ada"
    refused = max_.post("/api/v1/queue", {"hold": "another"})
    assert refused.status == 409
    assert "Ada is in control" in refused.document["detail"]
    assert max_.post("/api/v1/control/take").document == {"name": "Ada", "asked_by": "Max"}
    assert max_.post("/api/v1/control/give", {"to": "Max"}).status == 422
    assert ada.post("/api/v1/control/give", {"to": "Max"}).document["name"] == "Max"
    assert ada.post("/api/v1/queue/go-on").status == 409
    cells.wait_until(lambda: max_.state()["state"] == "halted", "the hold")
    assert max_.state()["halted"] == "hold: clean the glass"
    assert max_.post("/api/v1/queue/go-on").document["state"] == "idle"


@pytest.mark.parametrize(
    ("asked", "says"),
    [
        ({"plan": "../../etc/passwd"}, "expected a place below"),
        ({"plan": "/etc/passwd"}, "expected a place below"),
        ({"plan": "rig.yaml"}, "expected a plan"),
        ({"plan": "nothing.yaml"}, "nothing.yaml"),
        ({"plan": "wrong.yaml"}, "exposure"),
        ({"plan": "other.yaml"}, "its rig is"),
        ({"plan": "budget.yaml"}, "its budget is 0.01 lux.h"),
        ({"resume": "../../etc"}, "expected a place below"),
        ({"plan": "plan.yaml", "output": "/tmp"}, "only for the command line"),
        ({}, "either `plan` or `hold`"),
        ({"plan": "plan.yaml", "hold": "both"}, "either `plan` or `hold`"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_what_cannot_be_run_is_not_queued(staffed: Staffed, asked: dict[str, str], says: str) -> None:
    folder, plan = staffed.cell.folder, staffed.cell.plan_data
    (folder / "wrong.yaml").write_text(json.dumps({**plan, "exposure": {"kind": "fixed"}}))
    poor = {**plan, "object": {**plan["object"], "dose_budget_lux_h": 0.01}}
    (folder / "budget.yaml").write_text(json.dumps(poor))
    (folder / "other.yaml").write_text(json.dumps({**plan, "rig": str(cells.REPO / "configs/rigs/sim.yaml")}))
    refused = staffed.signed_in("Ada").post("/api/v1/queue", asked)
    assert refused.status == 422
    assert says in refused.document["detail"]
    assert all(entry["hold"] for entry in staffed.engineer.state()["queue"])


def test_the_command_line_is_heard_by_its_users_socket_alone(staffed: Staffed) -> None:
    ended = cells.here("queue", staffed.cell.rig, "--hold", "lunch", "--json")
    assert ended.code == 0, ended.err
    (entry,) = [entry for entry in ended.document["queue"] if entry["hold"] == "lunch"]
    assert entry["by"].endswith("(command line)")
    cells.wait_until(lambda: staffed.engineer.state()["state"] == "halted", "the hold")
    assert cells.here("queue", staffed.cell.rig, "--go-on").code == 0
    assert all(path.stat().st_mode & 0o077 == 0 for path in runtime_folder().glob("*.console"))
    second = cells.here("serve", staffed.cell.rig, "--port", "0")
    assert second.code == 2
    assert "another `coupole serve` has this cell" in second.err


def test_an_address_that_others_can_reach_is_refused_without_tls(staffed: Staffed) -> None:
    ended = cells.here("serve", staffed.cell.rig, "--host", "0.0.0.0", "--port", "0")
    assert ended.code == 2
    assert "--tls-certificate" in ended.err


# -- runs -----------------------------------------------------------------------------------------------------


@pytest.fixture
def long(tmp_path: Path) -> CellFolder:
    cell = CellFolder(tmp_path, speed=2.0)
    cell.write(lights=cells.SOME_LIGHTS, repeats=3)
    return cell


@pytest.mark.full  # in a browser: tests/console/test_a_day_at_the_console.py
def test_a_plan_is_checked_when_it_is_entered_and_its_run_paused_and_stopped_from_its_page(
    long: CellFolder,
) -> None:
    with served(long) as service:
        engineer = service.browser(token=service.token)
        engineer.post("/api/v1/queue", {"hold": "dust the object"})
        cells.wait_until(lambda: engineer.state()["state"] == "halted", "the hold")
        entered = engineer.post("/api/v1/queue", {"plan": "plan.yaml"}).document
        checked = cells.here("check", long.plan, "--json").document
        assert {name: entered["needs"][name] for name in ("frames", "bytes", "dose_lux_h", "object")} == {
            **{name: checked[name] for name in ("frames", "bytes", "dose_lux_h")},
            "object": "relief",
        }
        last = engineer.post("/api/v1/queue", {"hold": "turn it"}).document
        assert engineer.state()["queue"][1]["expected_begin"] is None, "a person decides"
        engineer.post("/api/v1/queue/go-on")
        assert engineer.post("/api/v1/queue", {"plan": "plan.yaml", "now": True}).status == 422
        cells.wait_until(lambda: engineer.state()["proven"] > 0, "proven frames")
        state = engineer.state()
        _, first, second = state["queue"]
        assert (first["state"], second["state"]) == ("running", "waiting")
        assert first["expected_end"] == second["expected_begin"] > state["t"]
        assert second["expected_end"] is None
        assert (state["state"], state["run"], state["view"]) == ("running", long.run_folder.name, "top")
        assert state["devices"]["camera"]["simulated"] is True
        assert state["dose"] > 0
        run = f"/api/v1/runs/{state['run']}"
        assert engineer.post("/api/v1/runs/another/stop").status == 422
        engineer.post(f"{run}/pause")
        cells.wait_until(lambda: engineer.state()["state"] == "paused", "the pause")
        assert cells.events(long.run_folder, "pause")
        assert engineer.post(f"{run}/go-on").status == 200
        cells.wait_until(lambda: engineer.state()["state"] == "running", "the end of the pause")
        assert engineer.post(f"{run}/stop").document["state"] == "stopping"
        cells.wait_until(lambda: engineer.state()["state"] == "halted", "the queue's halt")
        _, first, second = engineer.state()["queue"]
        assert (first["state"], first["exit_code"], second["state"]) == ("stopped", 130, "waiting")
        assert engineer.post(f"/api/v1/queue/{last['id']}", method="DELETE").status == 200
        assert engineer.post(f"/api/v1/queue/{first['id']}", method="DELETE").status == 422
    assert cells.events(long.run_folder, "stop")[-1]["outcome"] == "interrupted"


def test_a_killed_console_touches_no_run_and_comes_back_with_what_is_true(long: CellFolder) -> None:
    with served(long) as service:
        engineer = service.browser(token=service.token)
        engineer.post("/api/v1/queue", {"plan": "plan.yaml", "now": True})
        cells.wait_until(lambda: engineer.state()["proven"] > 0, "proven frames")
        service.process.kill()
        service.process.wait()
    run = long.run_folder
    with served(long) as again:
        engineer = again.browser(token=again.token)
        cells.wait_until(lambda: engineer.state()["queue"][0]["state"] == "done", "the end of the run")
        (entry,) = engineer.state()["queue"]
        assert (entry["run"], entry["exit_code"]) == (str(run), 0)
    cells.assert_each_shot_proven_once(run)
    assert cells.events(run, "stop")[-1]["outcome"] == "done"
