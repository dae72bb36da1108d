"""Takes a picture of the viewer's page for a browser: `python docs/images/browser.py RECORDING [--qt PYTHON]`.

Qt's browser is Chromium; it draws without a display and without a graphics card. PYTHON is that of an environment with
`pip install PyQt6-WebEngine` (not part of this project; Debian also wants libegl1, libnss3 and libxkbcommon0).
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
REPOSITORY = HERE.parent.parent
SIZE = (1600, 1000)
WITHIN = 120
"""Seconds for a page to be there, drawn by the CPU."""

PAGE = """
import os, sys
os.environ["QT_QPA_PLATFORM"] = "offscreen"
os.environ["QTWEBENGINE_CHROMIUM_FLAGS"] = "--no-sandbox --use-angle=swiftshader --enable-unsafe-swiftshader"
from PyQt6.QtCore import QTimer, QUrl
from PyQt6.QtWebEngineWidgets import QWebEngineView
from PyQt6.QtWidgets import QApplication

url, file, width, height, seconds = sys.argv[1:]
app = QApplication(sys.argv)
view = QWebEngineView()
view.resize(int(width), int(height))
view.page().renderProcessTerminated.connect(lambda how, code: (print(how, code), app.exit(1)))
view.show()
view.load(QUrl(url))
QTimer.singleShot(1000 * int(seconds), lambda: app.exit(0 if view.grab().save(file) else 1))
sys.exit(app.exec())
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", type=Path)
    parser.add_argument("--qt", default=sys.executable, help="a Python that has PyQt6-WebEngine")
    parser.add_argument("--out", type=Path, default=HERE / "browser.png")
    parser.add_argument("--seconds", type=int, default=40, help="until all of the recording is drawn")
    arguments = parser.parse_args()
    served = subprocess.Popen(
        [sys.executable, "-m", "dataflow.cli.main", "view", str(arguments.recording), "--to", "serve"],
        cwd=REPOSITORY, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        assert served.stderr is not None
        told = ""
        for told in served.stderr:
            if found := re.search(r"https?://\S+", told):
                break
        else:
            raise SystemExit(f"the viewer gave no address: {told.strip()}")
        words = [found[0], str(arguments.out), *map(str, SIZE), str(arguments.seconds)]
        subprocess.run([arguments.qt, "-c", PAGE, *words], check=True, timeout=arguments.seconds + WITHIN)
    finally:
        served.terminate()
        served.wait(20)
    print(arguments.out)


if __name__ == "__main__":
    main()
