"""The page holds what was measured, and its viewer works in a browser, from a file."""

import base64
import json
import re
import shutil

import numpy as np
import pytest

from experiments.comparison import page as pages
from tests.conftest import DATA
from tests.experiments.test_comparison import record

FEW = ("path tracing", "oidn", "whitened")
LINES = [
    record(name, error / spp, 0.5, spp=spp, denoising=float(name == "oidn"))
    for spp in (4, 16)
    for name, error in zip(FEW, (4.0, 2.0, 1.0), strict=True)
]


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    """The page of a made-up sweep and a real frame."""
    frames = [
        pages.shown(DATA / f"cornell-{name}-64.exr", (*FEW, "balanced"))
        for name in ("glass", "box")
    ]
    path = tmp_path_factory.mktemp("page") / "page.html"
    path.write_text(pages.page(LINES, frames, "RMSE"))
    return path


def test_page_holds_everything(page, glass_frame):
    text = page.read_text()
    assert "{{" not in text
    assert not re.search(r"(src|href)=\"(?!#)", text)  # nothing from elsewhere
    rows = re.findall(r"<tr( class=\"front\")?><td>([^<]+)</td><td>([\d.]+)", text)
    assert {(name, float(number)) for _, name, number in rows} == {
        ("path tracing", 2.0),
        ("oidn", 1.0),
        ("whitened", 0.5),
    }
    assert text.count("<svg") == 3
    held = pages.encoded(glass_frame.color)
    image = np.frombuffer(base64.b64decode(held), "<f2").reshape(64, 64, 3)
    np.testing.assert_allclose(image, glass_frame.color, rtol=1e-3, atol=1e-6)
    data = re.search(r'id="data" type="application/json">(.*?)</script>', text, re.S)
    frames = json.loads(data[1])
    assert list(frames[0]["estimated"]) == ["balanced"]
    error = np.frombuffer(base64.b64decode(frames[0]["estimated"]["balanced"]), "<f2")
    assert error.size == 64 * 64
    true = frames[0]["errors"]["balanced"]
    assert true / 3 < error.mean() < 3 * true


@pytest.fixture(scope="module")
def browser():
    """Headless Chromium."""
    paths = [shutil.which(name) for name in ("chromium", "chromedriver")]
    if None in paths:
        pytest.skip("needs Debian's chromium and chromium-driver")
    webdriver = pytest.importorskip("selenium.webdriver")
    options = webdriver.ChromeOptions()
    options.binary_location = paths[0]
    for flag in ("--headless=new", "--no-sandbox", "--window-size=1200,1600"):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    service = webdriver.ChromeService(executable_path=paths[1])
    driver = webdriver.Chrome(options=options, service=service)
    yield driver
    driver.quit()


def test_viewer_works_in_a_browser(browser, page):
    from selenium.webdriver import ActionChains

    browser.get(page.as_uri())
    press = lambda key: ActionChains(browser).send_keys(key).perform()
    state = lambda: browser.execute_script("return window.viewer")
    said = lambda: browser.find_element("id", "said").text
    pixels = lambda id_: browser.execute_script(
        "const c = document.getElementById(arguments[0]);"
        "const all = c.getContext('2d').getImageData(0, 0, c.width, c.height);"
        "return Array.from(all.data)",
        id_,
    )
    assert "path tracing: relative L2" in said()
    noisy, wrong = pixels("image"), pixels("error")
    assert np.std(noisy) > 0
    press("2")
    assert (state()["shown"], state()["before"]) == (1, 0)
    assert "oidn" in said()
    assert pixels("image") != noisy
    assert np.mean(pixels("error")) < np.mean(wrong)  # the denoised one is better
    press("4")
    true = pixels("error")
    press("m")
    assert "balanced" in said()
    assert "error as estimated" in said()
    assert np.std(pixels("error")) > 0
    assert pixels("error") != true
    press("m")
    assert pixels("error") == true
    press("2")
    press("5")
    assert "reference" in said()
    assert np.max(np.reshape(pixels("error"), (-1, 4))[:, :3]) == 0
    press("s")
    assert "left of the line oidn" in said()
    press("s")
    before = np.mean(pixels("image"))
    press("\ue013")  # arrow up: one stop brighter
    assert state()["stops"] == 1
    assert np.mean(pixels("image")) > before
    view = browser.find_element("id", "image")
    both = [pixels(name) for name in ("image", "error")]
    press("1")
    browser.execute_script(
        "arguments[0].dispatchEvent(new WheelEvent('wheel', {deltaY: -400, clientX: 99,"
        " clientY: 700, cancelable: true}))",
        view,
    )
    assert state()["zoom"] == pytest.approx(np.e)
    start = state()["x"]
    ActionChains(browser).click_and_hold(view).move_by_offset(30, 0).release().perform()
    assert state()["x"] > start
    assert [pixels(name) for name in ("image", "error")] != both
    press("e")
    assert state()["signed"]
    press("0")
    assert (state()["zoom"], state()["x"], state()["stops"]) == (1, 0, 0)
    press("f")
    assert state()["frame"] == 1
    assert [e for e in browser.get_log("browser") if e["level"] == "SEVERE"] == []


def test_bad_input(tmp_path):
    results = tmp_path / "r.jsonl"
    with pytest.raises(ValueError, match="has no results of experiments"):
        pages.run(pages.Config(results))
    results.write_text(json.dumps({"k": LINES[0]}))
    with pytest.raises(ValueError, match="no --frames"):
        pages.run(pages.Config(results))
