"""Helpers of the scope's tests: a run on a rig with its scope, and a browser that shows it."""

from __future__ import annotations

import asyncio
import json
import re
import shutil
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

PATIENCE_S = 60.0
# 1 kHz, so that two processors suffice for both sides and the browser
RIG = """
title = "A rig that is told what to do"
duration = 900.0
T_s = 1e-3
mode = "realtime"
law = "droop-5"
ready_laws = ["mimo-gfm-deployable", "vsg-2"]
after_trip = "wait"
seed = 1
[late_policy]
hold = 10000
[link]
type = "shm"
peer_timeout_s = 30.0
[plant]
delay = { samples = 1 }
factors = { R_f = 0.5, R_g = 0.5 }
dc_source = { mode = "regulated" }
[plant.sensors]
bandwidth_hz = 300.0
noise_std = { v_dc = 3e-5, p = 5e-4, q = 5e-4, V = 1e-4 }
"""

HAS_BROWSER = None not in (shutil.which("chromium"), shutil.which("chromedriver"))


@dataclass
class Rig:
    """A run in progress, and the addresses of its scope."""

    folder: Path
    look: str
    control: str
    process: subprocess.Popen[str]

    @property
    def token(self) -> str:
        return self.control.partition("#token=")[2]


def addresses(lines: Iterator[str]) -> tuple[str, str]:
    """The addresses to look and to control, from the output of a scope."""
    found: list[str] = []
    for line in lines:
        found += re.findall(r"https?://\S+", line)
        if len(found) == 2:
            return found[0], found[1]
    raise AssertionError("the scope has not said where it is")


@contextmanager
def rig(folder: Path, scenario: str = RIG) -> Iterator[Rig]:
    """Start a run with a scope; ends both."""
    file = folder / "rig.toml"
    file.write_text(scenario, encoding="utf-8")
    command = [sys.executable, "-m", "gfm_hil", "run", str(file), "--out", str(folder / "run")]
    process = subprocess.Popen(
        [*command, "--scope", "0", "--quiet", "--no-figures"],
        stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        assert process.stderr is not None
        yield Rig(folder / "run", *addresses(iter(process.stderr)), process)
    finally:
        process.terminate()
        process.wait(PATIENCE_S)


def words(socket: Any, kind: str) -> dict[str, Any]:
    """The next message of that kind."""
    while True:
        message = socket.recv(60)
        if isinstance(message, str) and json.loads(message)["kind"] == kind:
            return dict(json.loads(message))


@contextmanager
def serving(scope: Any) -> Iterator[int]:
    """Serve a ``Scope`` from a thread of this process; yields its port."""
    loop = asyncio.new_event_loop()
    ports: list[int] = []
    ready = threading.Event()

    def note(port: int) -> None:
        ports.append(port)
        ready.set()

    task = loop.create_task(scope.serve("127.0.0.1", [0], None, note))

    def work() -> None:
        try:
            loop.run_until_complete(task)
        except asyncio.CancelledError:
            loop.close()

    thread = threading.Thread(target=work)
    thread.start()
    try:
        assert ready.wait(PATIENCE_S)
        yield ports[0]
    finally:
        loop.call_soon_threadsafe(task.cancel)
        thread.join()


@contextmanager
def mute(port: int, *messages: str) -> Iterator[socket.socket]:
    """A page that opens a WebSocket, sends messages, and then reads nothing."""
    with socket.socket() as raw:
        raw.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2048)
        raw.connect(("127.0.0.1", port))
        raw.sendall(
            b"GET /socket HTTP/1.1\r\nHost: 127.0.0.1\r\nUpgrade: websocket\r\n"
            b"Connection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
            b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n"
        )
        for text in messages:
            assert len(text) < 126  # the short form of a frame, masked with zeros
            raw.sendall(bytes((0x81, 0x80 | len(text), 0, 0, 0, 0)) + text.encode())
        yield raw


class Browser:
    """Headless Chromium.

    Args:
        width, height: of the page, CSS pixels.
        dark: the emulated system preference for dark colours.
        phone: emulate touch and a high-resolution screen.
    """

    def __init__(
        self, width: int = 1440, height: int = 900, dark: bool = False, phone: bool = False
    ) -> None:
        from selenium import webdriver  # not in every process that collects tests

        options = webdriver.ChromeOptions()
        options.binary_location = shutil.which("chromium") or ""
        # a graphics processor that is emulated would take most of a processor
        for word in ("headless=new", "disable-gpu", "no-sandbox", "disable-dev-shm-usage"):
            options.add_argument(f"--{word}")
        options.add_argument(f"--window-size={width},{height}")
        options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
        service = webdriver.ChromeService(shutil.which("chromedriver") or "")
        self.driver = webdriver.Chrome(options=options, service=service)
        self.driver.execute_cdp_cmd(
            "Emulation.setDeviceMetricsOverride",
            {
                "width": width,
                "height": height,
                "deviceScaleFactor": 2 if phone else 1,
                "mobile": phone,
            },
        )
        self.driver.execute_cdp_cmd(
            "Emulation.setEmulatedMedia",
            {"features": [{"name": "prefers-color-scheme", "value": "dark" if dark else "light"}]},
        )

    def __enter__(self) -> Browser:
        return self

    def __exit__(self, *_: object) -> None:
        self.driver.quit()

    def js(self, text: str) -> Any:
        """Run a script; returns its result."""
        return self.driver.execute_script(text)

    def text(self, selector: str) -> str:
        """The text of an element."""
        return str(self.js(f"return document.querySelector({selector!r})?.textContent ?? ''"))

    def click(self, selector: str) -> None:
        """Click like a user: only if the element is visible and nothing covers it."""
        self.driver.find_element("css selector", selector).click()

    def write(self, selector: str, text: str) -> None:
        """Write text into a field."""
        field = self.driver.find_element("css selector", selector)
        field.clear()
        field.send_keys(text)

    def choose(self, selector: str, value: str) -> None:
        """Choose from a list."""
        from selenium.webdriver.support.ui import Select

        Select(self.driver.find_element("css selector", selector)).select_by_value(value)

    def drag(self, selector: str, start: tuple[int, int], by: tuple[int, int]) -> None:
        """Drag with the pointer, from a place relative to the element's centre."""
        from selenium.webdriver import ActionChains

        element = self.driver.find_element("css selector", selector)
        moves = ActionChains(self.driver).move_to_element_with_offset(element, *start)
        moves.click_and_hold().move_by_offset(by[0] // 2, by[1] // 2)
        moves.move_by_offset(by[0] - by[0] // 2, by[1] - by[1] // 2).release().perform()

    def complaints(self) -> list[str]:
        """The errors and warnings of the browser."""
        return [str(line["message"]) for line in self.driver.get_log("browser")]

    def picture(self, strip: str) -> list[int]:
        """The pixels of a strip's plot."""
        return list(
            self.js(
                f"const from = document.querySelector('[data-strip={strip}] canvas');"
                "const { width, height } = from;"
                "const to = new OffscreenCanvas(width, height).getContext('2d',"
                " { willReadFrequently: true });"
                "to.drawImage(from, 0, 0);"
                "return Array.from(to.getImageData(0, 0, width, height).data)"
                ".filter((v, k) => k % 97 == 0)"
            )
        )
