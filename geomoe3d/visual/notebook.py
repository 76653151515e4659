"""What a notebook shows of a result: the words, and a small page in which the clouds can be turned.

The page is that of `page`, thinned, inside a frame of its own, so that its style and script touch nothing of the
notebook. Some 200 kB, less than a second.
"""

from __future__ import annotations

from markupsafe import Markup

from geomoe3d.visual.drawing import STATUS_COLORS, STATUS_WORDS
from geomoe3d.visual.page import render_page
from geomoe3d.visual.view import RegistrationView

_FRAME = '<iframe srcdoc="{}" title="The two clouds" style="width:100%;height:460px;border:1px solid #8884"></iframe>'


def notebook_html(status: str, words: str, view: RegistrationView | None) -> str:
    """HTML of a result.

    Args:
        status: of the result.
        words: the answer in one paragraph, which begins with the status.
        view: what can be turned; None shows the words alone.
    """
    color, rest = STATUS_COLORS[status], words.removeprefix(status)
    text = Markup('<p><b style="color:{}">{}</b>{}</p>').format(color, STATUS_WORDS[status], rest)
    # Plain text: what is added to Markup would be escaped, in the hands of a user too.
    return (
        str(text) if view is None else str(text + Markup(_FRAME).format(render_page(view, max_points=4_000)))
    )
