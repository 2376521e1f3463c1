"""Chromium without a screen, for the pages that people look at."""

from __future__ import annotations

import shutil
from contextlib import suppress
from typing import Any

import cells
import psutil
import pytest
from selenium import webdriver
from selenium.webdriver.common.by import By
from selenium.webdriver.remote.webelement import WebElement

CHROMIUM, DRIVER = shutil.which("chromium"), shutil.which("chromedriver")
QUIET = (
    "--headless=new",
    "--no-sandbox",
    "--disable-gpu",
    "--enable-unsafe-swiftshader",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--window-size=1280,1000",
)
"""No screen, and no word to anybody but the page's own server."""

needs_chromium = pytest.mark.skipif(
    not (CHROMIUM and DRIVER), reason="Chromium and its driver are not installed (see tools/bootstrap.sh)"
)


class Browser:
    """One window."""

    def __init__(self, *more: str) -> None:
        options = webdriver.ChromeOptions()
        for option in (*QUIET, *more):
            options.add_argument(option)
        options.binary_location = CHROMIUM or ""
        options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
        self.driver = webdriver.Chrome(options, webdriver.ChromeService(DRIVER))
        self.driver.set_page_load_timeout(cells.PATIENCE_S)
        self.driver.set_script_timeout(cells.PATIENCE_S)

    def open(self, url: str) -> None:
        self.driver.get("about:blank")  # the page before asks its server no more
        self.driver.get_log("browser")
        self.driver.get(url)

    def at(self, selector: str) -> WebElement:
        found: WebElement = cells.wait_until(
            lambda: next(iter(self.driver.find_elements(By.CSS_SELECTOR, selector)), None), selector
        )
        return found

    def text(self, selector: str) -> str:
        return str(self.at(selector).text)

    def run(self, script: str) -> Any:
        return self.driver.execute_script(f"return {script}")

    def cpu_s(self) -> float:
        """CPU time that its processes have taken."""
        driver = psutil.Process(self.driver.service.process.pid)
        taken = 0.0
        for process in driver.children(recursive=True):
            with suppress(psutil.Error):  # one that has just ended
                times = process.cpu_times()
                taken += times.user + times.system
        return taken

    def troubles(self) -> list[str]:
        """What the page wrote to the console as an error: failed scripts and missing pictures."""
        return [line["message"] for line in self.driver.get_log("browser") if line["level"] == "SEVERE"]
