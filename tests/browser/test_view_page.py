"""The page of `bokehguide view` in headless Chromium, as a photographer uses it. Needs Chromium and its driver."""

from __future__ import annotations

import base64
import shlex
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from io import BytesIO
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from bokehguide.cli import main
from bokehguide.scene import Overrides, load_scene
from tests.support.scene_text import BOX_AND_EMITTER

webdriver = pytest.importorskip("selenium.webdriver")
from selenium.webdriver.common.action_chains import ActionChains  # noqa: E402
from selenium.webdriver.common.by import By  # noqa: E402
from selenium.webdriver.common.keys import Keys  # noqa: E402
from selenium.webdriver.support.select import Select  # noqa: E402
from selenium.webdriver.support.wait import WebDriverWait  # noqa: E402

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
DRIVER = shutil.which("chromedriver")
pytestmark = [pytest.mark.slow, pytest.mark.skipif(not (CHROMIUM and DRIVER), reason="no Chromium with its driver")]
SWITCHES = (
    *("--headless=new", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-sync"),
    *("--disable-background-networking", "--disable-component-update", "--window-size=1440,900"),
)
WAIT = 60.0


class Browser:
    """Chromium with the page of a command that runs in a folder."""

    def __init__(self, driver, address: str, folder: Path):
        self.driver, self.address, self.folder = driver, address, folder

    def open(self) -> None:
        self.driver.get(self.address)
        self.rest()

    def find(self, name: str):
        return self.driver.find_element(By.ID, name)

    def until(self, condition: Callable[[], object]) -> None:
        WebDriverWait(self.driver, WAIT, 0.05).until(lambda _: condition())

    def data(self, name: str) -> str:
        return self.driver.execute_script("return document.body.dataset[arguments[0]] ?? ''", name)

    def rest(self, after: int = 0) -> np.ndarray:
        """The exact picture of a revision above `after`, uint8 `[H, W, 3]`."""
        # Movements wait for the next frame of the screen, and changes for the answer to the one before.
        self.driver.execute_async_script("requestAnimationFrame(() => requestAnimationFrame(arguments[0]))")
        self.until(lambda: self.data("pending") in ("", "0") and int(self.data("state")) >= after)
        self.until(lambda: self.data("drawn") == self.data("state"))
        script = "return document.getElementById('picture').toDataURL('image/png').split(',')[1]"
        return np.asarray(Image.open(BytesIO(base64.b64decode(self.driver.execute_script(script)))).convert("RGB"))

    def changed(self, act: Callable[[], object]) -> np.ndarray:
        """The exact picture after an act that changes the state."""
        before = int(self.data("revision"))
        act()
        return self.rest(before + 1)

    def write(self, name: str, text: str) -> None:
        field = self.find(name)
        field.send_keys(Keys.CONTROL, "a")
        field.send_keys(text, Keys.ENTER)

    def click(self, x: float, y: float) -> None:
        """Click a point of the picture, in fractions."""
        frame = self.find("frame")
        size = frame.size
        place = int((x - 0.5) * size["width"]), int((y - 0.5) * size["height"])
        ActionChains(self.driver).move_to_element_with_offset(frame, *place).click().perform()

    def drag(self, x: float, y: float) -> None:
        ActionChains(self.driver).click_and_hold(self.find("frame")).move_by_offset(x, y).move_by_offset(3, 0).release().perform()

    def note(self) -> str:
        self.until(lambda: self.find("note").text)
        return self.find("note").text

    def errors(self) -> list[str]:
        """Errors and warnings of the console."""
        return [entry["message"] for entry in self.driver.get_log("browser") if entry["level"] in ("SEVERE", "WARNING")]


@pytest.fixture(scope="module")
def driver() -> Iterator:
    options = webdriver.ChromeOptions()
    options.binary_location = CHROMIUM
    for switch in SWITCHES:
        options.add_argument(switch)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    chromium = webdriver.Chrome(options=options, service=webdriver.ChromeService(DRIVER))
    yield chromium
    chromium.quit()


@pytest.fixture
def browser(driver, tmp_path, monkeypatch) -> Iterator[Browser]:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "box.toml").write_text(BOX_AND_EMITTER.replace("width = 32\nheight = 20", "width = 96\nheight = 60"))
    command = [sys.executable, "-m", "bokehguide", "view", "box.toml", "--port=0", "--no-browser", "--spp=4"]
    with subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            line = process.stdout.readline()
            assert "serves this machine alone; Ctrl-C ends" in line
            one = Browser(driver, line.split()[0], tmp_path)
            one.open()
            yield one
            errors = one.errors()
            driver.get("about:blank")
            process.send_signal(signal.SIGINT)
            _, stderr = process.communicate(timeout=60)
        finally:
            process.kill()  # a server outlives a failed test otherwise, and the exit of `with` waits for its end
        assert process.returncode == 0 and "Traceback" not in stderr and stderr.endswith("bokehguide: ended\n"), stderr
        assert not errors, errors


def run(command: str, *options: str) -> np.ndarray:
    """The PNG of a command."""
    assert main([*shlex.split(command)[1:], *options, "--out=again.exr"]) == 0
    return np.asarray(Image.open("again.png"))


def test_a_click_focuses_where_it_is(browser):
    browser.changed(lambda: browser.write("focus_distance", "7"))
    browser.changed(lambda: browser.click(0.27, 0.62))
    expected = load_scene("box.toml", Overrides(focus_at=(0.27, 0.62))).camera.focus_distance
    assert float(browser.find("focus_distance").get_attribute("value")) == pytest.approx(expected, rel=1e-2)


def test_sliders_and_fields_change_the_picture(browser):
    seen = [browser.rest()]
    slider = browser.driver.find_element(By.CSS_SELECTOR, "[data-control=f_number] input[type=range]")
    seen.append(browser.changed(lambda: slider.send_keys(*[Keys.ARROW_RIGHT] * 60)))
    for name, text in [
        ("focal_length", "80"),
        ("blades", "5"),
        ("rotation", "20"),
        ("cat_eye", "1"),
        ("environment_rotation", "40"),
    ]:
        before = seen[-1]
        seen.append(browser.changed(lambda: browser.write(name, text)))  # noqa: B023 - called at once
        assert name == "environment_rotation" or not np.array_equal(before, seen[-1]), name
    assert not np.array_equal(seen[0], seen[1])
    seen.append(browser.changed(lambda: Select(browser.find("view")).select_by_value("srgb")))
    seen.append(browser.changed(lambda: browser.find("denoise").click()))
    seen.append(browser.changed(lambda: Select(browser.find("mode")).select_by_value("uniform")))
    assert all(not np.array_equal(one, other) for one, other in zip(seen[-4:], seen[-3:]))


def test_drags_and_keys_move_the_camera(browser):
    seen = [browser.rest(), browser.changed(lambda: browser.drag(80, 30))]
    for tool in ("pan", "dolly", "look"):
        browser.driver.execute_script(f"document.querySelector('#tools input[value={tool}]').click()")
        seen.append(browser.changed(lambda: browser.drag(20, 60)))
    for key in ("w", "d", "e", Keys.ARROW_LEFT, "+"):
        seen.append(browser.changed(lambda: browser.find("frame").send_keys(key)))  # noqa: B023
    assert all(not np.array_equal(one, other) for one, other in pairwise(seen))
    first = browser.changed(lambda: browser.find("reset").click())
    np.testing.assert_array_equal(first, seen[0])


def test_the_picture_of_the_page_is_that_of_its_command_and_of_its_scene_file(browser):
    browser.changed(lambda: browser.click(0.27, 0.62))
    browser.changed(lambda: browser.drag(60, 10))
    shown = browser.changed(lambda: browser.write("f_number", "0.08"))
    command = browser.find("command").get_attribute("value")
    np.testing.assert_array_equal(shown, run(command))
    browser.find("save_scene").click()
    browser.until(lambda: Path("box-view.toml").exists())
    np.testing.assert_array_equal(shown, run(Path("box-view.toml").read_text().splitlines()[0].removeprefix("# ")))
    browser.find("render").click()
    browser.until(lambda: Path("box-view.png").exists())
    np.testing.assert_array_equal(shown, np.asarray(Image.open("box-view.png")))


def test_the_pixel_under_the_pointer_has_values_and_a_lens(browser):
    frame = browser.find("frame")
    ActionChains(browser.driver).move_to_element(frame).move_by_offset(5, 5).perform()
    browser.until(lambda: "Radiance" in browser.find("pixel").text)
    assert "β" in browser.find("pixel").text and "draws" in browser.find("disc_note").text
    drawn = "const c = document.getElementById('disc'); return c.getContext('2d').getImageData(128, 128, 1, 1).data[3]"
    assert browser.driver.execute_script(drawn) == 255


def test_the_values_of_a_pixel_follow_the_picture_while_the_pointer_rests(browser):
    ActionChains(browser.driver).move_to_element(browser.find("frame")).perform()
    browser.until(lambda: "Samples\n4" in browser.find("pixel").text)
    blur = browser.find("pixel").text.partition("Blur disc\n")[2].split("\n")[0]
    browser.changed(lambda: browser.write("focus_distance", "7"))
    browser.until(lambda: f"Blur disc\n{blur}" not in browser.find("pixel").text)
    browser.write("spp", "48")
    browser.driver.execute_script("document.getElementById('render').click()")  # the pointer stays
    browser.until(lambda: "Samples\n48" in browser.find("pixel").text)
    assert browser.find("samples").text == "48 / 48"


def test_a_refused_value_is_marked_until_its_field_is_left(browser):
    field, before = browser.find("f_number"), browser.find("f_number").get_attribute("value")
    browser.write("f_number", "-3")
    browser.until(lambda: field.get_attribute("aria-invalid") == "true")
    assert browser.note().startswith("f-number: -3.0 is out of range; give a number above 0")
    field.send_keys(Keys.TAB)
    assert field.get_attribute("value") == before and field.get_attribute("aria-invalid") is None


def test_an_emptied_field_is_a_pinhole_infinity_or_a_metered_exposure(browser):
    browser.changed(lambda: browser.write("f_number", Keys.DELETE))
    assert browser.find("f_number").get_attribute("placeholder") == "pinhole" and not browser.find("ratio").is_enabled()
    browser.changed(lambda: browser.write("focus_distance", Keys.DELETE))
    assert browser.find("focus_distance").get_attribute("placeholder") == "∞"
    assert "--aperture-radius=0.0" in browser.find("command").get_attribute("value")
    browser.write("fov", Keys.DELETE)
    assert browser.data("state") == browser.data("revision") and browser.find("fov").get_attribute("aria-invalid") is None


def test_a_drag_that_inspects_changes_nothing(browser):
    browser.driver.execute_script("document.querySelector('#tools input[value=inspect]').click()")
    browser.drag(60, 10)
    browser.click(0.27, 0.62)
    browser.until(lambda: "Radiance" in browser.find("pixel").text)
    assert browser.data("state") == "0"


def test_keys_inspect_and_focus(browser):
    browser.changed(lambda: browser.write("focus_distance", "7"))
    browser.driver.execute_script("document.querySelector('#tools input[value=inspect]').click()")
    browser.find("frame").send_keys(*[Keys.ARROW_LEFT] * 23, *[Keys.ARROW_DOWN] * 12)
    browser.until(lambda: f"{int(0.27 * 96)}, {int(0.62 * 60)} of 96×60" in browser.find("pixel").text)
    browser.changed(lambda: browser.find("frame").send_keys(Keys.ENTER))
    expected = load_scene("box.toml", Overrides(focus_at=(0.27, 0.62))).camera.focus_distance
    assert float(browser.find("focus_distance").get_attribute("value")) == pytest.approx(expected, rel=1e-2)


def test_a_layer_has_a_legend_and_a_stopped_render_continues(browser):
    assert browser.find("legend").text == ""
    browser.driver.execute_script("document.querySelector('#layers input[value=depth]').click()")
    browser.until(lambda: "bright" in browser.find("legend").text)
    browser.driver.execute_script("document.querySelector('#layers input[value=picture]').click()")
    browser.until(lambda: browser.find("legend").text == "")
    browser.changed(lambda: browser.write("spp", "100000"))
    browser.find("render").click()
    browser.until(lambda: browser.find("render").text == "Stop")
    browser.find("render").click()
    browser.until(lambda: browser.find("render").text == "Continue")


def test_two_fingers_dolly(browser):
    before = browser.rest()
    frame = browser.find("frame").rect
    middle, y = frame["x"] + frame["width"] / 2, frame["y"] + frame["height"] / 2

    def pinch() -> None:
        for kind, apart in [("touchStart", 40), ("touchMove", 60), ("touchMove", 80)]:
            points = [{"x": middle - apart, "y": y, "id": 0}, {"x": middle + apart, "y": y, "id": 1}]
            browser.driver.execute_cdp_cmd("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})
        browser.driver.execute_cdp_cmd("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})

    after = browser.changed(pinch)
    camera = load_scene("box.toml", Overrides()).camera
    words = dict(word.split("=") for word in shlex.split(browser.find("command").get_attribute("value")) if "=" in word)
    position, target = (np.array([float(x) for x in words[f"--camera-{name}"].split(",")]) for name in ("position", "target"))
    distance = np.linalg.norm(np.subtract(camera.position, camera.target))
    assert np.linalg.norm(position - target) == pytest.approx(0.5 * distance, rel=1e-3)
    assert not np.array_equal(before, after)


def test_the_plane_of_focus_can_be_marked(browser):
    drawn = "return document.getElementById('marker').toDataURL()"
    empty = browser.driver.execute_script(drawn)
    browser.changed(lambda: browser.click(0.27, 0.62))
    browser.find("marked").click()
    browser.until(lambda: browser.driver.execute_script(drawn) != empty)


def test_a_second_browser_watches_until_it_takes_over(browser):
    window = browser.driver.current_window_handle
    browser.driver.switch_to.new_window("window")
    browser.open()
    browser.until(lambda: "another browser steers" in browser.find("role").text)
    assert not browser.find("f_number").is_enabled() and not browser.find("render").is_enabled()
    assert browser.find("copy").is_enabled()
    browser.find("steer").click()
    browser.until(lambda: browser.find("f_number").is_enabled())
    browser.driver.close()
    browser.driver.switch_to.window(window)
    browser.until(lambda: browser.find("f_number").is_enabled())


def test_ctrl_z_undoes_the_last_change(browser):
    first, focus = browser.rest(), browser.find("focus_distance").get_attribute("value")
    browser.changed(lambda: browser.write("focus_distance", "7"))
    browser.changed(lambda: browser.find("frame").send_keys(Keys.CONTROL, "z"))
    assert browser.find("focus_distance").get_attribute("value") == focus and not browser.find("undo").is_enabled()
    np.testing.assert_array_equal(browser.rest(), first)


@pytest.mark.parametrize(("width", "height"), [(1440, 900), (390, 844)])
def test_the_page_fits_its_window(width, height, browser):
    size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 500}
    browser.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    try:
        browser.open()
        wide = "return document.documentElement.scrollWidth"
        assert browser.driver.execute_script(wide) <= width
        box = browser.find("frame").rect
        assert box["x"] >= 0 and box["x"] + box["width"] <= width and box["y"] + box["height"] <= height
        assert box["width"] * box["height"] >= 0.2 * width * height
        cut = "return [...document.querySelectorAll('label, button')].filter((each) => each.scrollWidth > each.clientWidth + 1)"
        assert not browser.driver.execute_script(f"{cut}.map((each) => each.textContent)")
        assert browser.find("disc").is_displayed()
        right = (
            "return [...document.querySelectorAll('#layers span, #tools span')].map((each) => each.getBoundingClientRect().right)"
        )
        assert max(browser.driver.execute_script(right)) <= width
    finally:
        browser.driver.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
