"""First screens of all kinds of pages: `python docs/page_pictures.py FOLDER`, JPEG files of pages that exist below.

    twin run quickstart --out runs/pages/run
    twin run quickstart --seed 2 --set scene_seed=1 --set objects.2.growth_m=0.05 --out runs/pages/second
    twin products runs/pages/run --out runs/pages/products
    twin change runs/pages/run runs/pages/second --out runs/pages/change
    twin compare runs/pages/run runs/pages/second --out runs/pages/compare.html
    twin study turbidity --out runs/pages/study
    twin tune docs/pages/murky.toml --out runs/pages/tuning
    python docs/page_pictures.py runs/pages

A page without its file is left out. Needs Chromium.
"""

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import cv2

PAGES = {
    "report": "run/report.html",
    "products": "products/products.html",
    "change": "change/change.html",
    "compare": "compare.html",
    "study": "study/study.html",
    "tuning": "tuning/tuning.html",
}
WIDTH_PX, HEIGHT_PX, QUALITY = 1280, 1000, 52
FLAGS = "--headless --no-sandbox --disable-gpu --hide-scrollbars --no-first-run".split()


def main(folder: Path) -> None:
    """Writes docs/pages/NAME.jpg of each page of a folder."""
    chromium = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if chromium is None:
        raise SystemExit("Chromium is not installed")
    target = Path(__file__).parent / "pages"
    target.mkdir(exist_ok=True)
    for name, page in PAGES.items():
        if (folder / page).is_file():
            with tempfile.TemporaryDirectory() as work:
                shot = Path(work) / "page.png"
                size = f"--window-size={WIDTH_PX},{HEIGHT_PX}"
                options = [f"--user-data-dir={work}/profile", size, f"--screenshot={shot}"]
                subprocess.run(
                    [chromium, *FLAGS, *options, (folder / page).resolve().as_uri()], check=True, capture_output=True
                )
                image = cv2.imread(str(shot))
                assert image is not None
            cv2.imwrite(str(target / f"{name}.jpg"), image, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])


if __name__ == "__main__":
    main(Path(sys.argv[1]))
