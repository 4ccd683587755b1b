"""The page holds what was measured, and its viewer works in a browser, from a file."""

import json
import re

import numpy as np
import pytest

from experiments.comparison import page as pages
from tests.conftest import DATA
from tests.experiments.test_comparison import record
from tests.test_viewer import Viewer

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


def test_page_holds_everything(page):
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
    data = re.search(r"data-scenes>(.*?)</script>", text, re.DOTALL)
    scenes = json.loads(data[1])["scenes"]
    assert [scene["name"] for scene in scenes] == ["cornell-glass-64", "cornell-box-64"]
    *images, reference = scenes[0]["images"]
    assert [image["name"] for image in images] == [*FEW, "balanced"]
    assert reference["name"] == "reference"
    assert [list(image["maps"]) for image in images] == [[], [], [], ["estimated"]]
    assert all(image["note"].startswith("relative L2 ") for image in images)


def test_its_viewer_works_in_a_browser(browser, page):
    browser.get(page.as_uri())
    viewer = Viewer(browser)
    viewer.press("4")
    viewer.press("e", pane=1)
    viewer.press("e", pane=1)
    assert (
        viewer.text(".pane:nth-child(2) select:nth-of-type(2)", "value") == "estimated"
    )
    assert np.std(viewer.pixels(1)[..., :3]) > 0
    viewer.press("n")
    assert "cornell-box-64" in viewer.address()
    assert viewer.complaints() == []


def test_bad_input(tmp_path):
    results = tmp_path / "r.jsonl"
    with pytest.raises(ValueError, match="has no results of experiments"):
        pages.run(pages.Config(results))
    results.write_text(json.dumps({"k": LINES[0]}))
    with pytest.raises(ValueError, match="no --frames"):
        pages.run(pages.Config(results))
