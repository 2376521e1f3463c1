"""Somebody who sits before a console in a real browser: looks, clicks, types, and is checked for by axe-core."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

import cells
from browser import Browser
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys
from selenium.webdriver.remote.webelement import WebElement
from selenium.webdriver.support.select import Select

LOOK_EVERY_S = 0.15
"""Looking costs the browser, and others, time."""
WIDE, NARROW = (1400, 900), (400, 800)
_SETTLES_S = 3.0
_SERIOUS = ("serious", "critical")
_LISTENS = """
window.notified = [];
const heard = new WeakMap();
new MutationObserver(() => {
    for (const one of document.querySelectorAll(".q-notification")) {
        if (one.innerText && heard.get(one) !== one.innerText) {
            heard.set(one, one.innerText);
            window.notified.push(one.innerText);
        }
    }
}).observe(document, {childList: true, subtree: true, characterData: true});
"""
"""In every page: notes each message at the foot of the screen, which is gone after seconds."""


class Visitor:
    """A person in a window."""

    def __init__(self, browser: Browser, url: str) -> None:
        self.browser, self.driver, self.url = browser, browser.driver, url
        self.prefers("light")
        self.driver.execute_cdp_cmd("Page.addScriptToEvaluateOnNewDocument", {"source": _LISTENS})

    def goes_to(self, path: str) -> None:
        self.driver.get(self.url + path)

    def signs_in(self, name: str, password: str) -> None:
        self.goes_to("/")
        self.types("#name", name)
        self.types("#password", password + Keys.ENTER)
        self.sees("[data-name=state]")

    def at(self, selector: str) -> WebElement:
        return self.browser.at(selector)

    def all(self, selector: str) -> list[WebElement]:
        return list(self.driver.find_elements(By.CSS_SELECTOR, selector))

    def sees(self, selector: str, words: str = "") -> str:
        """Wait until there is such an element with these words."""

        def there() -> str:
            texts: str = self.driver.execute_script(
                "return [...document.querySelectorAll(arguments[0])].map(one => one.innerText || one.value || ' ')"
                ".join('\\n')",
                selector,
            )
            if texts and words in texts:
                return texts
            time.sleep(LOOK_EVERY_S)
            return ""

        return str(cells.wait_until(there, f"{words!r} in {selector}"))

    def is_told(self, words: str) -> None:
        """Wait for a message at the foot of the screen with these words; it and those before it are done with."""
        told: list[str] = []

        def there() -> bool:
            told.extend(self.driver.execute_script("return window.notified.splice(0)"))
            return any(words in one for one in told)

        cells.wait_until(there, f"the message {words!r}")

    def clicks(self, selector: str, words: str = "") -> None:
        """On the first such element that says these words, as soon as it can be clicked."""

        def clicked() -> bool:
            for one in self.all(selector):
                if words in one.text and one.is_displayed() and one.is_enabled():
                    self.driver.execute_script("arguments[0].scrollIntoView({block: 'center'})", one)
                    one.click()
                    return True
            return False

        self._patiently(clicked, f"{words!r} in {selector} to click")

    def types(self, selector: str, words: str) -> None:
        """Into a field, in place of what stands there."""

        def typed() -> bool:
            field = self.at(selector)
            field.send_keys(Keys.CONTROL, "a")
            field.send_keys(words)
            return True

        self._patiently(typed, f"{selector} to type into")

    def signs_out(self) -> None:
        self.clicks("[data-name=person]")
        self.clicks("[data-name=sign-out]")
        self.at("#password")

    def chooses(self, selector: str, value: str) -> None:
        """From a list."""
        self._patiently(lambda: Select(self.at(selector)).select_by_value(value) is None, f"{value} of {selector}")

    def presses(self, key: str) -> None:
        """A key, wherever the focus is."""
        ActionChains(self.driver).send_keys(key).perform()

    def _patiently(self, do: Callable[[], bool], what: str) -> None:
        """Elements are made anew while one looks at them."""
        from selenium.common.exceptions import WebDriverException

        def done() -> bool:
            with suppress(WebDriverException):
                if do():
                    return True
            time.sleep(LOOK_EVERY_S)
            return False

        cells.wait_until(done, what)

    def resizes(self, size: tuple[int, int]) -> None:
        """The page's own size, without the window's frame."""
        self.driver.execute_cdp_cmd(
            "Emulation.setDeviceMetricsOverride",
            {"width": size[0], "height": size[1], "deviceScaleFactor": 1, "mobile": False},
        )

    def prefers(self, scheme: str) -> None:
        """`light` or `dark`; without motion, as colours that are on their way have no contrast yet."""
        wanted = {"prefers-color-scheme": scheme, "prefers-reduced-motion": "reduce"}
        features = [{"name": name, "value": value} for name, value in wanted.items()]
        self.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": features})

    def picture(self, path: Path) -> None:
        """What is seen now, as PNG."""
        path.parent.mkdir(parents=True, exist_ok=True)
        self.driver.save_screenshot(str(path))

    def fits(self) -> bool:
        """The page is not wider than its window, as soon as it has settled."""
        end_s = time.monotonic() + _SETTLES_S
        while self.overflows() and time.monotonic() < end_s:
            time.sleep(0.1)
        return not self.overflows()

    def overflows(self) -> int:
        """Pixels by which the page is wider than its window."""
        page = "document.documentElement"
        return int(self.browser.run(f"{page}.scrollWidth - {page}.clientWidth"))

    def too_wide(self) -> list[str]:
        """What reaches beyond the window's right edge."""
        found: list[str] = self.browser.run(
            "[...document.querySelectorAll('main *, header *')].filter(one => one.getBoundingClientRect().right > "
            "document.documentElement.clientWidth + 1).map(one => one.outerHTML.slice(0, 120)).slice(0, 8)"
        )
        return found

    def barriers(self) -> list[str]:
        """Serious violations of accessibility that axe-core finds on this page."""
        self.driver.execute_script(_axe())
        found: dict[str, Any] = json.loads(
            self.driver.execute_async_script(
                "const done = arguments[0]; axe.run({resultTypes: ['violations']})"
                ".then(found => done(JSON.stringify(found)));"
            )
        )
        return [
            f"{one['id']}: {node['html'][:160]} {node['failureSummary'][:300]}"
            for one in found["violations"]
            if one["impact"] in _SERIOUS
            for node in one["nodes"]
        ]


def assert_usable(visitor: Visitor) -> None:
    """Whatever is on the screen now, at both sizes, in light and dark."""
    for size, scheme in ((NARROW, "dark"), (WIDE, "light")):
        visitor.resizes(size)
        visitor.prefers(scheme)
        assert visitor.fits(), (size, visitor.too_wide())
        assert visitor.barriers() == [], (size, scheme)
    assert visitor.browser.troubles() == []


@cache
def _axe() -> str:
    package = files("axe_selenium_python")
    return package.joinpath("node_modules", "axe-core", "axe.min.js").read_text(encoding="utf-8")
