"""Hook of mkdocs: links to files of the repository outside docs/ become plain words, since the site lacks them."""

import re


def on_page_markdown(markdown, page, **_):
    """Called by mkdocs with the text of every page."""
    up = "../" * page.file.src_uri.count("/")
    return re.sub(rf"\[([^\]]+)\]\({re.escape(up)}\.\./[^)]*\)", r"\1", markdown)
