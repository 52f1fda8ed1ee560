"""Random use of the page of `bokehguide view` in headless Chromium: memory and the console's errors, minute by minute.

    scripts/view_random_use.py SCENE --minutes 60 --seed 0

prints a line of JSON for each minute, and a last one with the growth of memory. Needs Chromium, its driver and Selenium. The exit
code is 1 if the console has errors, or if the server dies. One seed gives one sequence of acts; the times differ.
"""

from __future__ import annotations

import argparse
import json
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from selenium import webdriver
from selenium.common.exceptions import WebDriverException
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys

SWITCHES = ("--headless=new", "--no-sandbox", "--disable-gpu", "--disable-background-networking", "--window-size=1440,900")
FIELDS = {
    "focus_distance": (0.3, 30.0),
    "f_number": (0.7, 16.0),
    "focal_length": (15.0, 120.0),
    "blades": (0, 9),
    "rotation": (-90.0, 90.0),
    "curvature": (0.0, 1.0),
    "ratio": (0.6, 1.8),
    "cat_eye": (0.0, 1.2),
    "edge": (-1.0, 1.0),
    "exposure": (-2.0, 3.0),
    "spp": (40, 90),
}
"""Ranges of the numbers that are typed; curvature and rotation without blades are refused, which the page tells."""
KEYS = (
    *("w", "a", "s", "d", "q", "e", "p", "+", "-", Keys.ARROW_LEFT, Keys.ARROW_RIGHT, Keys.ARROW_UP, Keys.ARROW_DOWN),
    Keys.ENTER,
)
BUTTONS = ("infinity", "marked", "auto", "denoise", "render", "reset", "save_picture", "save_scene", "copy")


@dataclass
class User:
    """A photographer without a plan. acts: number of acts by name."""

    driver: Any
    address: str
    dice: random.Random
    acts: dict[str, int] = field(default_factory=dict)

    def act(self) -> None:
        """One act, and a pause of at most two seconds."""
        name, act = self.dice.choice(ACTS)
        self.acts[name] = self.acts.get(name, 0) + 1
        act(self)
        time.sleep(self.dice.choice((0.0, 0.05, 0.3, 0.6, 2.0)))

    def find(self, name: str) -> Any:
        return self.driver.find_element(By.ID, name)

    def place(self) -> tuple[int, int]:
        """A point of the picture from its centre, pixels."""
        size = self.find("frame").size
        return tuple(int(self.dice.uniform(-0.45, 0.45) * size[each]) for each in ("width", "height"))  # type: ignore[return-value]

    def click(self) -> None:
        ActionChains(self.driver).move_to_element_with_offset(self.find("frame"), *self.place()).click().perform()

    def hover(self) -> None:
        ActionChains(self.driver).move_to_element_with_offset(self.find("frame"), *self.place()).pause(0.5).perform()

    def drag(self) -> None:
        tool = self.dice.choice(("orbit", "pan", "dolly", "look"))
        self.driver.execute_script(f"document.querySelector('#tools input[value={tool}]').click()")
        chain = ActionChains(self.driver, duration=20).click_and_hold(self.find("frame"))
        for _ in range(self.dice.randint(2, 30)):
            chain.move_by_offset(self.dice.randint(-6, 6), self.dice.randint(-4, 4))
        chain.release().perform()

    def key(self) -> None:
        self.find("frame").send_keys(*[self.dice.choice(KEYS)] * self.dice.randint(1, 8))

    def write(self) -> None:
        name = self.dice.choice(list(FIELDS))
        low, high = FIELDS[name]
        place = self.find(name)
        if place.is_enabled():
            value = self.dice.uniform(low, high)
            place.send_keys(Keys.CONTROL, "a")
            place.send_keys(str(round(value)) if isinstance(low, int) else f"{value:.3g}", Keys.ENTER)

    def slide(self) -> None:
        name = self.dice.choice(list(FIELDS))
        slider = self.driver.find_element(By.CSS_SELECTOR, f"[data-control={name}] input[type=range]")
        if slider.is_enabled():
            slider.send_keys(*[self.dice.choice((Keys.ARROW_LEFT, Keys.ARROW_RIGHT))] * self.dice.randint(1, 25))

    def choose(self) -> None:
        name = self.dice.choice(("view", "mode", "layers"))
        selector = f"#{name} input" if name == "layers" else f"#{name} option"
        choices = self.driver.find_elements(By.CSS_SELECTOR, selector)
        if name == "layers" and choices:  # the inputs lie under their texts
            self.driver.execute_script("arguments[0].click()", self.dice.choice(choices))
        elif choices:  # none before the page has its scene
            self.dice.choice(choices).click()

    def press(self) -> None:
        self.driver.execute_script("document.getElementById(arguments[0]).click()", self.dice.choice(BUTTONS))

    def reopen(self) -> None:
        self.driver.get("about:blank")
        time.sleep(self.dice.uniform(0.0, 3.0))
        self.driver.get(self.address)

    def resize(self) -> None:
        self.driver.set_window_size(*self.dice.choice(((1440, 900), (1920, 1080), (700, 900), (500, 844))))


ACTS: list[tuple[str, Callable[[User], None]]] = [
    (name, getattr(User, name))
    for name, weight in (
        *(("click", 4), ("hover", 4), ("drag", 8), ("key", 6), ("write", 8), ("slide", 8), ("choose", 4), ("press", 4)),
        *(("reopen", 1), ("resize", 1)),
    )
    for _ in range(weight)
]
"""Acts by name, each as often as its weight."""


def main() -> int:
    options = parse()
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "bokehguide", "view", options.scene, "--port=0", "--no-browser", "--spp=48"]
        command += ["--size", options.size]
        with subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as server:
            assert server.stdout and server.stderr
            address = server.stdout.readline().split()[0]
            try:
                bad = use(server, address, options)
            finally:
                server.send_signal(signal.SIGINT)
            errors = server.stderr.read()
            print(json.dumps({"exit": server.wait(60), "stderr": errors[-400:]}), flush=True)
            return int(bad or "Traceback" in errors)


def use(server: subprocess.Popen[str], address: str, options: argparse.Namespace) -> bool:
    """Act until the time is over; returns whether the console had errors or the server died."""
    chrome = webdriver.ChromeOptions()
    for switch in SWITCHES:
        chrome.add_argument(switch)
    chrome.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    driver = webdriver.Chrome(options=chrome, service=webdriver.ChromeService(shutil.which("chromedriver")))
    user, found, resident = User(driver, address, random.Random(options.seed)), [], []
    driver.get(address)
    begin = time.monotonic()
    try:
        while server.poll() is None and time.monotonic() - begin < 60.0 * options.minutes:
            minute = begin + 60.0 * (len(resident) + 1)
            while server.poll() is None and time.monotonic() < minute:
                try:
                    user.act()
                except WebDriverException as error:  # an element that moves away, or is covered
                    user.acts[type(error).__name__] = user.acts.get(type(error).__name__, 0) + 1
            errors = [entry["message"] for entry in driver.get_log("browser") if entry["level"] in ("SEVERE", "WARNING")]
            found += errors
            resident.append(resident_mb(server.pid))
            heap = driver.execute_script("return performance.memory.usedJSHeapSize") / 2**20
            line = {
                "minute": len(resident),
                "server_mb": resident[-1],
                "heap_mb": round(heap, 1),
                "acts": sum(user.acts.values()),
            }
            print(json.dumps(line | {"errors": errors}), flush=True)
    finally:
        driver.quit()
    quarter = max(1, len(resident) // 4)
    early, late = max(resident[quarter : 2 * quarter], default=0), max(resident[-quarter:], default=0)
    total = {"acts": user.acts, "errors": len(found), "peak_second_quarter_mb": early, "peak_last_quarter_mb": late}
    print(json.dumps(total | {"died": server.poll()}), flush=True)
    return bool(found) or server.poll() is not None


def resident_mb(pid: int) -> int:
    """Resident memory of a process, MB (Linux)."""
    found = re.search(r"VmRSS:\s+(\d+)", Path(f"/proc/{pid}/status").read_text())
    return int(found[1]) // 1024 if found else 0


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", nargs="?", default="fairy-lights")
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--size", default="320x180", help="of the picture")
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())
