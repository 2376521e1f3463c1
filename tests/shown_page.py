"""The page of `coupole show` in a real browser, from disk and without a network."""

from __future__ import annotations

import base64
import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cells
import numpy as np
from browser import Browser
from lazily import lazily
from selenium.webdriver.common.action_chains import ActionChains

from coupole.reflectance.new_light.pictured_surface import FreeCamera

colour: Any = lazily("colour")

FIELD_DEG = 24.0
"""Of the page's camera, along the shorter side."""
WIDTH, HEIGHT = 160, 120
SMALL = 780, 440
"""Of the window: quick to draw, and wide enough for the panel beside the picture."""
CONTROLS = "a[href], button, input, select, summary, canvas[tabindex]"


class Page:
    """The page in a window."""

    def __init__(self, browser: Browser) -> None:
        self.browser, self.driver = browser, browser.driver
        self.opened: Path | None = None
        self.beginning: dict[str, Any] = {}

    def open(self, path: Path, address: str = "") -> None:
        """Open a page, or have an open one begin anew in its present size: shaders take a second to compile."""
        if path == self.opened and not address:
            self.driver.execute_script("document.querySelector('[data-tool=turn]').click()")
            self.driver.execute_script("coupole.setSamples(1); coupole.state = arguments[0]", self.beginning)
            return
        self.opened = None if address else path
        self.browser.open(f"{path.as_uri()}{address}")
        cells.wait_until(lambda: self.run("Boolean(window.coupole?.readPixel)"), "the page's interface")
        self.run("coupole.setSamples(1)")  # it rests after each change
        self.show_settings()
        self.beginning = self.run("coupole.state")

    def show_settings(self, *sections: str) -> None:
        """Open the panel, and sections of it."""
        self.driver.execute_script("document.querySelector('#settings[aria-expanded=false]')?.click()")
        for name in sections:
            self.driver.execute_script(f"document.getElementById('{name}').open = true")

    def run(self, script: str) -> Any:
        return self.browser.run(script)

    def wide(self) -> None:
        """The picture has the size that the window gives it."""
        self.driver.execute_script("document.getElementById('stage').style.cssText = ''")
        cells.wait_until(lambda: self.run("document.getElementById('picture').width") != WIDTH, "the size")
        self.browser.at("[data-tool=turn]").click()

    def small(self) -> None:
        """The picture has a size that is quick to draw."""
        self.driver.execute_script(
            f"document.getElementById('stage').style.cssText = 'width:{WIDTH}px; height:{HEIGHT}px'"
        )
        cells.wait_until(lambda: self.run("document.getElementById('picture').width") == WIDTH, "the size")

    def look(self, azimuth: float, height: float, distance: float, softness: float = 0.0) -> FreeCamera:
        """Put the camera somewhere, with one light; the same camera for others."""
        camera = {"target": [0, 0, 0], "azimuth": azimuth, "height": height, "distance": distance}
        light = f"{{...coupole.state.lights[0], softness: {softness}}}"
        self.driver.execute_script(f"coupole.state = {{camera: {camera}, lights: [{light}], chosen: 0, sky: 0}}")
        a, h = math.radians(azimuth), math.radians(height)
        at = distance * np.array([math.cos(h) * math.cos(a), math.cos(h) * math.sin(a), math.sin(h)])
        across = 2.0 * math.degrees(math.atan(math.tan(math.radians(FIELD_DEG / 2)) * WIDTH / HEIGHT))
        return FreeCamera(at, np.zeros(3), (WIDTH, HEIGHT), across)

    def picture(self, samples: int) -> np.ndarray:
        """[h, w, 4] float32: linear red, green, blue, and how much of a pixel has a material."""
        text = self.driver.execute_script(f"""
            coupole.setSamples({samples});
            const bytes = new Uint8Array(coupole.readPicture().rgba.buffer);
            let letters = "";
            for (let k = 0; k < bytes.length; k += 32768) {{
              letters += String.fromCharCode(...bytes.subarray(k, k + 32768));
            }}
            return btoa(letters);""")
        return np.frombuffer(base64.b64decode(text), np.float32).reshape(HEIGHT, WIDTH, 4)

    def keys(self, *keys: str) -> None:
        ActionChains(self.driver).send_keys(*keys).perform()

    def focus(self, name: str) -> None:
        self.driver.execute_script(f"document.getElementById('{name}').focus()")

    def wait_for_all(self) -> None:
        """Until all that the picture needs has come."""
        self.driver.execute_async_script("coupole.whole().then(arguments[0])")


def difference(picture: np.ndarray, other: np.ndarray, white: float) -> np.ndarray:
    """CIEDE2000 of two linear pictures, shown as sRGB with a white."""
    lab = [
        colour.XYZ_to_Lab(
            colour.sRGB_to_XYZ(colour.cctf_encoding(np.clip(one / white, 0.0, 1.0))), [0.3127, 0.329]
        )
        for one in (picture, other)
    ]
    found: np.ndarray = colour.delta_E(*lab, method="CIE 2000")
    return found


@contextmanager
def opened_page() -> Iterator[Page]:
    browser = Browser("--force-prefers-reduced-motion")  # else the light moves
    browser.driver.set_window_size(*SMALL)
    browser.driver.set_network_conditions(offline=True, latency=0, throughput=0)
    yield Page(browser)
    browser.driver.quit()
