"""Make the pictures of docs/gallery.md: run the examples that draw, and shrink what they drew.

    python scripts/gallery.py [FOLDER]

Under 200 kB each; half a minute.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parents[1]
EXAMPLES = ("two_scans", "corridor")
WIDTH, COLORS = 1100, 48


def main(folder: Path) -> None:
    from PIL import Image

    for name in EXAMPLES:
        with tempfile.TemporaryDirectory() as place:
            subprocess.run([sys.executable, str(ROOT / "examples" / f"{name}.py")], cwd=place, check=True)
            drawn = Image.open(Path(place, f"{name}.png")).convert("RGB")
            drawn = drawn.resize((WIDTH, round(drawn.height * WIDTH / drawn.width)), Image.Resampling.LANCZOS)
            drawn.quantize(COLORS).save(folder / f"gallery_{name}.png", optimize=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "docs" / "images")
