"""The page in a real browser: it draws, moves and colours the clouds, and loads nothing from anywhere.

Skipped where there is no Chromium or no Playwright. What the page draws is judged by screenshots of its canvas.
"""

import dataclasses
import io
import shutil

import numpy as np
import pytest

from urrt_jax.viewer import save_page, show_registration

playwright = pytest.importorskip("playwright.sync_api", reason="Playwright drives the browser: pip install playwright")
BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
if BROWSER is None:
    pytest.skip("there is no Chromium: apt-get install chromium", allow_module_level=True)

# Without a graphics card WebGL is computed; Chromium's sandbox does not run for root.
ARGUMENTS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]


@pytest.fixture(scope="module")
def browser():
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=BROWSER, args=ARGUMENTS)
        yield browser
        browser.close()


class Shown:
    """A page in a window, and what went wrong in it."""

    def __init__(self, context, address: str):
        self.problems, self.requests = [], []
        self.page = context.new_page()
        self.page.on("console", lambda message: self.problems.append(message.text))
        self.page.on("pageerror", lambda error: self.problems.append(str(error)))
        self.page.on("request", lambda request: self.requests.append(request.url))
        self.page.goto(address)
        self.page.wait_for_selector("html[data-drawn]", state="attached")

    def picture(self) -> np.ndarray:
        """The canvas, (height, width, 3), once the frame that was asked for is drawn."""
        self.page.evaluate("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
        # The buttons and the axes lie over the canvas.
        style = "#view > :not(canvas) { visibility: hidden }"
        return pixels(self.page.locator("#canvas").screenshot(style=style))

    def ink(self) -> np.ndarray:
        """Where the canvas is not paper, (height, width)."""
        picture = self.picture()
        return np.abs(picture - picture[0, 0]).max(axis=-1) > 40

    def slide(self, share: float) -> None:
        self.page.locator("#along").evaluate(
            "(slider, share) => { slider.value = share; slider.dispatchEvent(new Event('input')) }", share
        )

    def choose(self, group: str, value: str) -> None:
        self.page.locator(f'input[name="{group}"][value="{value}"] + span').click()


def pixels(png: bytes) -> np.ndarray:
    from matplotlib.image import imread

    return np.round(255 * imread(io.BytesIO(png))[..., :3]).astype(int)


def differ(first: np.ndarray, second: np.ndarray) -> float:
    """The share of pixels that differ visibly."""
    return float((np.abs(first - second) > 10).any(axis=-1).mean())


@pytest.fixture
def show(browser, tmp_path):
    """A function of (source, target, result) that opens their page in a window."""
    contexts = []

    def opened(*arguments, title: str | None = None, address: str | None = None, **window) -> Shown:
        if address is None:
            save_page(tmp_path / "page.html", *arguments, title=title)
            address = (tmp_path / "page.html").as_uri()
        contexts.append(browser.new_context(**{"viewport": {"width": 900, "height": 600}} | window))
        return Shown(contexts[-1], address)

    yield opened
    for context in contexts:
        context.close()


@pytest.fixture(scope="module")
def aligned(cloud_pair, registration):
    """Two clouds of the same points in two poses, and the true result."""
    source, target, matrix = cloud_pair
    return source, target, registration(source, target, matrix=matrix)


@pytest.fixture(scope="module")
def cloud_pair(matrix):
    source = np.random.default_rng(3).normal(size=(800, 3)) * [1.0, 0.5, 0.25]
    return source, source @ matrix[:3, :3].T + matrix[:3, 3], matrix


def test_page_opens_without_a_message_or_a_request(aligned, show):
    shown = show(*aligned)
    for key in ("c", "c", "s", "s", "t", "t", "d", "u", "p", "+", "-", "r", "ArrowLeft"):
        shown.page.keyboard.press(key)
    shown.picture()
    assert shown.problems == []
    assert [url for url in shown.requests if not url.startswith(("file:", "data:"))] == []


def test_both_clouds_are_drawn(aligned, show):
    assert show(*aligned).ink().mean() > 0.01


def alone(shown: Shown, name: str) -> np.ndarray:
    """The canvas with one cloud, coloured by region."""
    for each in ("source", "target"):
        shown.choose(f"{each}-colour", "region")
        shown.page.set_checked(f"#{each}", each == name)
    return shown.picture()


def test_after_the_motion_the_source_lies_on_the_target(cloud_pair, registration, show):
    source, target, matrix = cloud_pair
    result = registration(source, target, matrix=matrix)
    shown = show(source, target, dataclasses.replace(result, target_regions=result.source_regions))
    assert differ(alone(shown, "source"), alone(shown, "target")) < 1e-3


def test_before_the_motion_the_source_is_where_it_was(cloud_pair, registration, show):
    source, _, matrix = cloud_pair
    shown = show(source, source, registration(source, source, matrix=matrix))
    shown.slide(0)
    assert differ(alone(shown, "source"), alone(shown, "target")) < 1e-3


def test_the_slider_moves_the_source(aligned, show):
    shown = show(*aligned)
    pictures = []
    for share in (0, 0.5, 1):
        shown.slide(share)
        pictures.append(shown.picture())
    assert min(differ(pictures[0], pictures[1]), differ(pictures[1], pictures[2])) > 0.01


def test_both_ends_of_the_motion_are_in_view(aligned, show):
    shown = show(*aligned)
    for share in (0, 1):
        shown.slide(share)
        ink = shown.ink()
        assert ink.any() and not (ink[[0, -1]].any() or ink[:, [0, -1]].any())


def test_space_plays_the_motion_to_its_other_end(aligned, show):
    shown = show(*aligned, reduced_motion="reduce")
    for end in ("0", "1"):
        shown.page.keyboard.press("Space")
        playwright.expect(shown.page.locator("#along")).to_have_js_property("value", end)


def test_clouds_can_be_hidden(aligned, show):
    shown = show(*aligned)
    shown.page.uncheck("#source")
    shown.page.uncheck("#target")
    assert not shown.ink().any()


def test_every_colouring_differs(aligned, show):
    shown = show(aligned[0], aligned[1] + 0.02, aligned[2])
    pictures = []
    for colouring in ("plain", "region", "residual"):
        shown.choose("source-colour", colouring)
        pictures.append(shown.picture())
    assert min(differ(pictures[one], pictures[other]) for one, other in ((0, 1), (1, 2), (0, 2))) > 0.005


def test_the_target_can_be_coloured_by_region(aligned, show):
    shown = show(*aligned)
    shown.page.uncheck("#source")
    plain = shown.picture()
    shown.choose("target-colour", "region")
    assert differ(plain, shown.picture()) > 0.005


def test_larger_points_cover_more(aligned, show):
    shown = show(*aligned)
    few = shown.ink().sum()
    for _ in range(4):
        shown.page.keyboard.press("+")
    assert shown.ink().sum() > 1.1 * few


def test_dragging_turns_the_clouds_and_reset_turns_them_back(aligned, show):
    shown = show(*aligned)
    first = shown.picture()
    box = shown.page.locator("#canvas").bounding_box()
    shown.page.mouse.move(box["x"] + 300, box["y"] + 300)
    shown.page.mouse.down()
    shown.page.mouse.move(box["x"] + 400, box["y"] + 250, steps=3)
    shown.page.mouse.up()
    assert differ(first, shown.picture()) > 0.01
    shown.page.click("#reset")
    assert differ(first, shown.picture()) == 0


def test_another_pose_is_shown_with_its_matrix(cloud_pair, registration, show):
    source, target, matrix = cloud_pair
    shown = show(source, target, registration(source, target, matrix=matrix, others=((np.eye(4), 0.3),)))
    first = shown.picture()
    shown.page.locator('input[name="pose"][value="1"]').check()
    assert shown.page.locator("#matrix tr").first.inner_text().split() == ["1.00000", "0.00000", "0.00000", "0"]
    assert differ(first, shown.picture()) > 0.01


def test_the_matrix_is_copied_with_all_digits(cloud_pair, registration, show):
    source, target, matrix = cloud_pair
    shown = show(source, target, registration(source, target, matrix=matrix), permissions=["clipboard-read"])
    shown.page.click("#copy")
    shown.page.wait_for_selector("#copy:text('Copied')")
    np.testing.assert_array_equal(eval(shown.page.evaluate("navigator.clipboard.readText()")), matrix)


def test_why_it_did_not_converge_is_told(pair, registration, show):
    result = registration(*pair, converged=False)
    assert result.reason.lower() in show(*pair, result).page.inner_text("#verdict").lower()


def test_a_title_of_markup_is_shown_as_text(pair, registration, show):
    title = "<script>document.body.remove()</script><b>&amp;"
    shown = show(*pair, registration(*pair), title=title)
    assert shown.page.inner_text("h1") == shown.page.title() == title


@pytest.mark.parametrize("broken", ["pose", "source", "both"])
def test_what_is_not_finite_does_not_break_the_page(pair, registration, show, broken):
    clouds = [np.full((4, 3), np.nan) if broken in (name, "both") else pair[0] for name in ("source", "target")]
    matrix = np.full((4, 4), np.nan) if broken != "source" else np.eye(4)
    shown = show(*clouds, registration(*clouds, matrix=matrix, converged=False))
    shown.picture()
    assert shown.problems == []


def test_a_large_page_is_drawn(registration, show):
    clouds = np.random.default_rng(4).normal(size=(2, 100_000, 3))
    shown = show(*clouds, registration(*clouds))
    assert shown.ink().mean() > 0.1 and shown.problems == []


def test_thinning_is_told(pair, registration, show):
    large = np.random.default_rng(5).normal(size=(200_001, 3))
    shown = show(large, pair[1], registration(large, pair[1]))
    assert "Of the source, 200,000 points are shown." in shown.page.inner_text("#notes")


def test_dark_windows_get_dark_paper(aligned, show):
    light, dark = (show(*aligned, color_scheme=scheme).picture()[0, 0] for scheme in ("light", "dark"))
    np.testing.assert_array_equal(light, [0xFB, 0xFB, 0xF9])
    np.testing.assert_array_equal(dark, [0x14, 0x17, 0x1B])


def test_a_narrow_window_needs_no_sideways_scrolling(aligned, show):
    shown = show(*aligned, viewport={"width": 360, "height": 640})
    assert shown.page.evaluate("document.documentElement.scrollWidth") <= 360
    assert shown.ink().any()


def test_a_notebooks_frame_shows_the_page(aligned, browser, tmp_path):
    (tmp_path / "notebook.html").write_text(show_registration(*aligned)._repr_html_(), encoding="utf-8")
    page = browser.new_page()
    page.goto((tmp_path / "notebook.html").as_uri())
    page.frame_locator("iframe").locator("html[data-drawn]").wait_for(state="attached")
    page.close()
