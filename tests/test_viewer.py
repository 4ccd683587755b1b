"""The viewer: what its page holds, and what a browser shows of it."""

import base64
import re
import socket
import struct
import threading
import time
import zlib

import jax.numpy as jnp
import numpy as np
import pytest

from jscomb import metrics, viewer
from jscomb.viewer._page import packed

HEIGHT, WIDTH = 24, 32


class Viewer:
    """The viewer of the page that a browser shows, as a reader uses it."""

    def __init__(self, browser, root=0):
        self.browser, self.root = browser, root
        self.wait()

    def run(self, script, *arguments):
        """Run a script with `root`, the viewer's element, and `a`, the arguments."""
        found = (
            f"const root = document.querySelectorAll('.jscomb-viewer')[{self.root}];"
        )
        script = f"const a = Array.from(arguments); {found} {script}"
        return self.browser.execute_script(script, *arguments)

    def wait(self):
        """Wait until all is painted."""
        end = time.monotonic() + 30
        while self.run("return root?.dataset.ready") != "yes":
            assert time.monotonic() < end, "the viewer is never ready"
            time.sleep(0.02)

    def press(self, key, *, pane=0):
        """Press a key over a pane."""
        self.point(pane, 0.5, 0.5)
        from selenium.webdriver import ActionChains

        ActionChains(self.browser).send_keys(key).perform()
        self.wait()

    def stage(self, pane):
        """Return the element of a pane."""
        return self.run("return root.querySelectorAll('.stage')[a[0]]", pane)

    def actions(self, pane, x, y):
        """A chain that begins over a pane, at fractions of its size."""
        from selenium.webdriver import ActionChains

        stage = self.stage(pane)
        self.browser.execute_script("arguments[0].scrollIntoView()", stage)
        width, height = stage.size["width"], stage.size["height"]
        offset = round((x - 0.5) * width), round((y - 0.5) * height)
        chain = ActionChains(self.browser, duration=0)
        return chain.move_to_element_with_offset(stage, *offset), width, height

    def point(self, pane, x, y):
        """Move the pointer to a place in a pane."""
        self.actions(pane, x, y)[0].perform()
        self.wait()

    def drag(self, pane, start, end, key=None):
        """Drag from one place to another."""
        chain, width, height = self.actions(pane, *start)
        by = round((end[0] - start[0]) * width), round((end[1] - start[1]) * height)
        chain = chain.key_down(key) if key else chain
        chain = chain.click_and_hold().move_by_offset(*by).release()
        (chain.key_up(key) if key else chain).perform()
        self.wait()

    def pixels(self, pane):
        """What a pane shows, [H,W,4]."""
        size, values = self.run(
            "const c = root.querySelectorAll('.stage > canvas')[a[0]];"
            "const d = c.getContext('2d').getImageData(0, 0, c.width, c.height);"
            "return [[c.height, c.width], Array.from(d.data)]",
            pane,
        )
        return np.reshape(values, (*size, 4))

    def points(self, pane):
        """What a pane shows at the middle of each pixel of the whole image."""
        shown = self.pixels(pane)
        height, width, _ = shown.shape
        fit = min(width / WIDTH, height / HEIGHT)
        at = lambda n, size: ((np.arange(n) + 0.5 - n / 2) * fit + size / 2).astype(int)
        return shown[at(HEIGHT, height)][:, at(WIDTH, width)]

    def text(self, selector, what="textContent"):
        """Return a property of an element."""
        return self.run("return root.querySelector(a[0])[a[1]]", selector, what)

    def value(self, pane):
        """Return what is said of the pixel under the pointer."""
        return self.run(
            "return root.querySelectorAll('.value')[a[0]].textContent", pane
        )

    def state(self):
        """Return what the viewer is at."""
        return self.run("return root.viewer.state")

    def address(self):
        """Return the page's address."""
        return self.browser.current_url

    def complaints(self):
        """Return the errors that the browser has logged."""
        return [e for e in self.browser.get_log("browser") if e["level"] == "SEVERE"]


@pytest.fixture(scope="module")
def images():
    """A reference, and images; one has a firefly and a pixel that is not finite."""
    rng = np.random.default_rng(0)
    reference = rng.uniform(0.1, 0.6, (HEIGHT, WIDTH, 3)).astype(np.float32)
    noisy = reference * rng.uniform(0.5, 1.5, reference.shape).astype(np.float32)
    noisy[3, 5], noisy[7, 9, 1] = 1e6, np.nan
    return {"noisy": noisy, "smooth": 0.9 * reference + 0.03}, reference


@pytest.fixture(scope="module")
def scene(images):
    made, reference = images
    steps = np.linspace(0, 1, HEIGHT * WIDTH, dtype=np.float32)
    maps = {"flip": {"smooth": steps.reshape(HEIGHT, WIDTH, 1)}}
    return viewer.make_scene("first", made, reference=reference, maps=maps)


@pytest.fixture
def opened(browser, scene, images, tmp_path):
    """A page of two scenes, in the browser."""
    other = viewer.make_scene("second", {"grey <b>": 1e-8 * images[1]})
    path = tmp_path / "page.html"
    path.write_text(viewer.page([scene, other]))
    browser.get("about:blank")
    browser.get(path.as_uri())
    return Viewer(browser)


def srgb(v):
    v = np.clip(v, 0, 1)
    return np.where(v <= 0.0031308, 12.92 * v, 1.055 * v ** (1 / 2.4) - 0.055)


def test_numbers_come_back(rng):
    for values, kind, dtype in (
        (rng.normal(size=(4, 5, 3)), "half", "<f2"),
        (np.array([[[np.nan], [np.inf], [1e-3]]]), "half", "<f2"),
        (np.array([[[1e6], [-2.0], [np.nan]]]), "float", "<f4"),
    ):
        found, text = packed(values)
        assert found == kind
        size = np.dtype(dtype).itemsize
        planes = np.frombuffer(zlib.decompress(base64.b64decode(text)), np.uint8)
        bits = np.ascontiguousarray(planes.reshape(size, -1).T)
        back = bits.view(dtype).reshape(values.shape)
        np.testing.assert_array_equal(back, values.astype(dtype))


def test_page_needs_nothing_else(scene):
    text = viewer.page([scene], title="a <b>")
    assert "<title>a &lt;b&gt;</title>" in text
    assert not re.search(r"(src|href)\s*=|https?:|@import|url\(", text)
    cell = viewer.Cell([scene], height=300)._repr_html_()
    assert cell.startswith('<iframe style="width: 100%; height: 300px')
    assert cell.count('"') == 4  # nothing ends the attribute early


def test_scenes_are_checked():
    grey = np.full((4, 4, 3), 0.2)
    make = viewer.make_scene
    with pytest.raises(ValueError, match="s: a scene needs an image"):
        make("s", {})
    with pytest.raises(
        ValueError, match=r"s: a is \(4, 4\), expected \(H, W, 3 or 1\)"
    ):
        make("s", {"a": grey[..., 0]})
    with pytest.raises(ValueError, match=r"b is \(3, 4, 3\), a is \(4, 4, 3\)"):
        make("s", {"a": grey, "b": grey[1:]})
    with pytest.raises(ValueError, match=r"flip map of c is \(4, 4, 1\), expected"):
        make("s", {"a": grey}, maps={"flip": {"c": grey[..., :1]}})
    with pytest.raises(ValueError, match="the viewer needs a scene"):
        viewer.page([])


def test_shows_the_values_of_the_images(opened, images, scene):
    """As displayed by sRGB at the exposure that is said; bad pixels in magenta."""
    (noisy, smooth), reference = images[0].values(), images[1]
    stops = opened.state()["stops"]
    assert stops == round(np.log2(0.18 / np.median(reference.mean(-1))))
    for key, image in (("1", noisy), ("2", smooth), ("3", reference)):
        opened.press(key)
        shown = opened.points(0)[..., :3]
        bad = ~np.isfinite(image).all(-1)
        np.testing.assert_array_equal(
            shown[bad], np.tile([255, 0, 255], (bad.sum(), 1))
        )
        expected = 255 * srgb(np.where(bad[..., None], 0, image) * 2.0**stops)
        np.testing.assert_allclose(shown[~bad], expected[~bad], atol=1.5)
    opened.press("2")
    opened.press("t")  # the filmic curve is that of the metrics
    assert opened.state()["curve"] == "filmic"
    expected = 255 * np.asarray(metrics.tone_map(jnp.asarray(smooth) * 2.0**stops))
    np.testing.assert_allclose(opened.points(0)[..., :3], expected, atol=1.5)
    opened.press("\ue013")  # arrow up
    assert opened.state()["stops"] == stops + 0.5
    expected = 255 * np.asarray(
        metrics.tone_map(jnp.asarray(smooth) * np.float32(2 ** (stops + 0.5)))
    )
    np.testing.assert_allclose(opened.points(0)[..., :3], expected, atol=1.5)
    assert opened.complaints() == []


def test_shows_errors_by_the_colour_bar(opened, images, scene):
    """The second pane follows the first; the range is adjustable."""
    import matplotlib as mpl

    smooth, reference = images[0]["smooth"], images[1]
    magma = np.asarray(mpl.colormaps["magma"](np.arange(256), bytes=True))[:, :3]

    def colours(share):
        return magma[np.clip(np.round(255 * share), 0, 255).astype(int)].astype(int)

    opened.press("2")
    error = np.asarray(metrics.rel_l2_map(jnp.asarray(smooth), jnp.asarray(reference)))[
        ..., 0
    ]
    shown = opened.points(1)[..., :3]
    np.testing.assert_allclose(shown, colours(np.log10(error / 1e-4) / 4), atol=8)
    opened.press("]", pane=1)
    assert opened.state()["ranges"]["relative"] == [3.16e-4, 3.16]
    shown = opened.points(1)[..., :3]
    np.testing.assert_allclose(shown, colours(np.log10(error / 3.16e-4) / 4), atol=8)
    opened.press("e", pane=1)  # signed
    opened.press("e", pane=1)
    assert opened.text(".colours span") == "FLIP"
    flip = scene.maps["flip"]["smooth"][..., 0]
    np.testing.assert_allclose(opened.points(1)[..., :3], colours(flip), atol=8)
    _, high = opened.browser.find_elements("css selector", ".colours input")
    high.send_keys("\ue009a\ue009", "0.5\n")  # control a selects what is there
    opened.wait()
    assert opened.state()["ranges"]["flip"] == [0, 0.5]
    np.testing.assert_allclose(opened.points(1)[..., :3], colours(2 * flip), atol=8)
    menu = opened.browser.find_element("css selector", ".pane select")
    menu.find_element("css selector", "option:nth-of-type(3)").click()
    opened.wait()
    assert opened.state()["panes"][0]["image"] == 2
    opened.press("1")  # has no such map
    assert opened.pixels(1).max() == 0
    assert opened.complaints() == []


def test_says_the_values_under_the_pointer(opened, images):
    noisy, reference = images[0]["noisy"], images[1]
    opened.press("1")
    for y, x in ((10, 11), (3, 5)):
        opened.point(1, 0.5, 0.5)
        fit = opened.run(
            "const s = root.querySelector('.stage'); return Math.min("
            "s.clientWidth / a[0], s.clientHeight / a[1])",
            WIDTH,
            HEIGHT,
        )
        width, height = (opened.stage(1).size[k] for k in ("width", "height"))
        place = (
            0.5 + (x + 0.5 - WIDTH / 2) * fit / width,
            0.5 + (y + 0.5 - HEIGHT / 2) * fit / height,
        )
        opened.point(1, *place)
        for pane in (0, 1):
            said = opened.value(pane)
            assert said.startswith(f"({x}, {y})")
            numbers = re.findall(r"[\d.]+(?:e[+-]\d+)?", said.partition(")")[2])
            expected = [
                *noisy[y, x],
                metrics.rel_l2_map(jnp.asarray(noisy), jnp.asarray(reference))[y, x, 0],
            ]
            np.testing.assert_allclose([float(n) for n in numbers], expected, rtol=6e-3)
    crosses = opened.run("return root.querySelectorAll('.cross:not([hidden])').length")
    assert crosses == 2


def test_flips_slides_zooms_and_remembers_it_in_the_address(opened, browser):
    from selenium.webdriver.common.keys import Keys

    opened.press("2")
    opened.press("3")
    opened.press("s")
    whole = opened.pixels(0)
    opened.drag(0, (0.5, 0.5), (0.25, 0.5))
    assert opened.state()["split"] == pytest.approx(0.25, abs=0.01)
    moved = opened.pixels(0)
    middle, quarter = whole.shape[1] // 2, whole.shape[1] // 4
    assert (
        moved[:, quarter + 9 : middle - 9] != whole[:, quarter + 9 : middle - 9]
    ).any()
    np.testing.assert_array_equal(moved[:, middle + 9 :], whole[:, middle + 9 :])
    assert opened.text(".line", "dataset")["before"] == "smooth"
    opened.press("+")
    opened.drag(0, (0.6, 0.6), (0.7, 0.6))
    state = opened.state()
    assert state["zoom"] == 1.5
    assert state["x"] < 0.5 == pytest.approx(state["y"], abs=1e-3)
    opened.drag(1, (0.4, 0.4), (0.6, 0.5), key=Keys.SHIFT)
    assert len(opened.state()["crops"]) == 1
    opened.press("p")
    panes, address = opened.state()["panes"], opened.address()
    assert len(panes) == 3
    inset = opened.run("return root.querySelectorAll('.insets canvas').length")
    assert inset == 6  # three images, and their errors
    browser.get("about:blank")
    browser.get(address)
    again = Viewer(browser)
    after = again.state()
    assert after["panes"] == panes
    assert after["crops"] == opened.state()["crops"] != []
    assert {"zoom": 1.5, "slide": True}.items() <= after.items()
    assert again.address() == address
    again.press("c")
    again.press("0")
    assert (again.state()["zoom"], again.state()["crops"]) == (1, [])
    assert again.complaints() == []


def test_an_inset_says_the_error_of_its_crop(opened, images, browser):
    smooth, reference = images[0]["smooth"], images[1]
    browser.execute_script("location.hash = 'crop=2,4,8,6'")
    opened.wait()
    assert opened.state()["crops"] == [[2, 4, 8, 6]]
    said = opened.text(".insets figure:nth-of-type(2) figcaption")
    crop = metrics.rel_l2_map(jnp.asarray(smooth), jnp.asarray(reference))[
        4:10, 2:10
    ].mean()
    np.testing.assert_allclose(float(said.removeprefix("smooth ")), crop, rtol=0.02)


def test_other_scenes_and_any_address(opened, browser):
    opened.press("n")
    assert opened.text("select", "value") == "1"
    assert opened.state()["stops"] > 20  # a radiance of 1e-8 is shown all the same
    assert np.ptp(opened.points(0)[..., :3]) > 50
    assert "1  grey <b>" in opened.text(".pane select")
    for hash_ in (
        "pane=%5B",
        "zoom=x&curve=none&crop=1&scene=none",
        "pane=%5B%22q%22%5D",
    ):
        browser.execute_script("location.hash = arguments[0]", hash_)
        opened.wait()
        assert opened.state()["scene"] == 0
    assert opened.complaints() == []


def test_two_viewers_share_a_page(browser, scene, tmp_path):
    path = tmp_path / "two.html"
    cell = viewer.Cell([scene])._repr_html_()
    path.write_text("<meta charset=utf-8>" + 2 * viewer.element([scene]) + cell)
    browser.get(path.as_uri())
    first, second = Viewer(browser), Viewer(browser, root=1)
    first.press("2")
    assert first.state()["panes"][0]["image"] == 0  # it has not the focus
    first.run("root.focus()")
    first.press("2")
    shown = [each.state()["panes"][0]["image"] for each in (first, second)]
    assert shown == [1, 0]
    assert "#" not in first.address()
    browser.switch_to.frame(0)
    Viewer(browser).press("2")
    browser.switch_to.default_content()
    assert first.complaints() == []


def test_what_cannot_be_shown_is_said(browser, tmp_path):
    path = tmp_path / "wide.html"
    wide = viewer.make_scene("wide", {"a": np.ones((1, 99_999, 1), np.float32)})
    path.write_text(viewer.page([wide]))
    browser.get(path.as_uri())
    said = browser.find_element("css selector", ".failed").text
    assert re.fullmatch(
        r"wide is 99999x1 pixels; this browser shows at most \d+\.", said
    )


def test_images_reach_tev(images):
    """Over its protocol, decoded here by what its documentation says."""
    pytest.importorskip("tevclient")
    server = socket.create_server(("localhost", 0))
    server.settimeout(20)
    got = bytearray()

    def listen():
        connection, _ = server.accept()
        with connection:
            while data := connection.recv(2**16):
                got.extend(data)

    thread = threading.Thread(target=listen)
    thread.start()
    made, reference = images
    scene = viewer.make_scene("s", {"smooth": made["smooth"]}, reference=reference)
    viewer.send_to_tev(scene, port=server.getsockname()[1])
    thread.join(20)
    server.close()
    packets = []
    while got:
        size, kind = struct.unpack_from("<IB", got)
        packets.append((kind, bytes(got[5:size])))
        del got[:size]
    assert [kind for kind, _ in packets] == [4, 6, 4, 6]  # create, update; twice
    assert packets[0][1][1:].startswith(b"s/smooth\0")
    values = np.frombuffer(packets[1][1][-4 * HEIGHT * WIDTH * 3 :], "<f4")
    np.testing.assert_array_equal(values, made["smooth"].ravel())
    with pytest.raises(ConnectionError, match="no tev answers at localhost:9"):
        viewer.send_to_tev(scene, port=9)
