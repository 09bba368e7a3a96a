"""The README's picture of the page: that of `urrt demo`'s pair, as Chromium shows it.

    python experiments/demo/run.py

Writes page.png. Needs Playwright (in the extra ``dev``) and Chromium.
"""

import shutil
import tempfile
from pathlib import Path

from playwright.sync_api import sync_playwright

from urrt_jax import register
from urrt_jax.atomic import write_atomically
from urrt_jax.cli.demo import Demo, demo_pair
from urrt_jax.viewer import save_page

HERE = Path(__file__).parent
# Without a graphics card WebGL is computed; Chromium's sandbox does not run for root.
ARGUMENTS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]


def photograph(page: Path) -> bytes:
    """A PNG of the page in a browser, with the source coloured by its residuals."""
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=shutil.which("chromium"), args=ARGUMENTS)
        window = browser.new_page(viewport={"width": 1200, "height": 680}, color_scheme="light")
        window.goto(page.as_uri())
        window.locator("html[data-drawn]").wait_for(state="attached")
        window.locator('input[value="residual"] + span').click()
        window.evaluate("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
        picture = window.screenshot()
        browser.close()
    return picture


def main() -> None:
    source, target, _, _ = demo_pair(Demo.seed, noise=Demo.noise, keep=Demo.keep)
    with tempfile.TemporaryDirectory() as folder:
        page = Path(folder) / "page.html"
        save_page(page, source, target, register(source, target), title="urrt demo")
        write_atomically(HERE / "page.png", photograph(page))


if __name__ == "__main__":
    main()
