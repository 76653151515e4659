"""Self-contained pages from the templates that lie beside the code (``<room>/<name>.html``).

Values are escaped as they are filled in, so a file name that looks like HTML or like a template stays a file
name. Pages with clouds to turn share a frame: ``visual/page_frame.html`` with its style and scripts.
"""

from __future__ import annotations

import base64
import json
from functools import lru_cache
from importlib import resources
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from geomoe3d.types import FloatArray


def render(template: str, /, **values: Any) -> str:
    """The text of a template, such as ``batch/page.html``; markup among the values must be `Markup`."""
    return _environment().get_template(template).render(values)


def render_cloud_page(room: str, name: str, values: dict[str, Any], data: dict[str, Any]) -> str:
    """The text of a page with clouds to turn.

    Args:
        room: folder of the package with ``name``.html (the inside of the body), ``name``.css and ``name``.js.
        name: of these files.
        values: for the body; ``title`` and ``generator`` (a meta element, as `Markup`) are for the head.
        data: for the script, which finds it as JSON in the element "data".
    """
    return render(
        "visual/page_frame.html",
        **values,
        body=f"{room}/{name}.html",
        styles=[_read("visual/page_frame.css"), _read(f"{room}/{name}.css")],
        scripts=[_read(f) for f in ("visual/page_draw.js", "visual/page_view.js", f"{room}/{name}.js")],
        data=_script_json(data),
    )


def base64_floats(values: FloatArray) -> str:
    """Numbers as the scripts unpack them: little-endian float32 in base64."""
    return base64.b64encode(np.ascontiguousarray(values, dtype="<f4").tobytes()).decode("ascii")


def _script_json(data: dict[str, Any]) -> Markup:
    """JSON for the inside of a script element: no character in it can end the element or open another."""
    text = json.dumps(data, allow_nan=False, separators=(",", ":"))
    return Markup(text.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e"))


def _read(name: str) -> Markup:
    return Markup(resources.files("geomoe3d").joinpath(name).read_text(encoding="utf-8"))


@lru_cache(maxsize=1)
def _environment() -> Environment:
    return Environment(
        loader=PackageLoader("geomoe3d", ""),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
