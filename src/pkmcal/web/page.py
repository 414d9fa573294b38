"""HTML of the viewer: a shell with the document, and the bundle inlined or beside it.

A self-contained page may fetch nothing: its Content-Security-Policy allows the scripts and styles
with the hashes of the bundle, and no other, whatever a name in a file holds.
"""

from __future__ import annotations

import json
from base64 import b64encode
from hashlib import sha256
from html import escape

from pkmcal.web.bundle_files import SCRIPT_FILE, STYLE_FILE, bundle_file
from pkmcal.web.document import AnyDocument, PageDocument

PAGE_MARK = '<meta name="generator" content="pkmcal viewer">'
"""Element of the pages that are written here, and of no other page."""
DOCUMENT_START, DOCUMENT_END = '<script type="application/json" id="document">', "</script>"
FRAME_HEIGHT = 700
"""Height of a page in a notebook, px."""


def standalone_page(document: PageDocument) -> str:
    """Page in one file that opens without a network."""
    script, style = bundle_file(SCRIPT_FILE), bundle_file(STYLE_FILE)
    policy = (
        f"default-src 'none'; img-src data: blob:; style-src {_hash_source(style)};"
        f" script-src {_hash_source(script)}; base-uri 'none'; form-action 'none'"
    )
    return _shell(
        document,
        head=f'<meta http-equiv="Content-Security-Policy" content="{policy}">\n'
        f"<style>{style}</style>",
        end=f"<script>{script}</script>",
    )


def served_page(document: AnyDocument) -> str:
    """Page beside which a server has the bundle; the server's headers hold its policy."""
    return _shell(
        document,
        head=f'<link rel="stylesheet" href="{STYLE_FILE}">',
        end=f'<script src="{SCRIPT_FILE}"></script>',
    )


def page_frame(page: str, title: str) -> str:
    """Frame with a page, for notebooks; its scripts reach nothing of the notebook."""
    return (
        f'<iframe srcdoc="{escape(page)}" sandbox="allow-scripts allow-downloads" loading="lazy"'
        f' title="{escape(title)}" width="100%" height="{FRAME_HEIGHT}" style="border: 0"></iframe>'
    )


def _hash_source(text: str) -> str:
    """Source expression of an inline script or style in a Content-Security-Policy."""
    return f"'sha256-{b64encode(sha256(text.encode('utf-8')).digest()).decode('ascii')}'"


def _shell(document: AnyDocument, head: str, end: str) -> str:
    return f"""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
{PAGE_MARK}
<title>{escape(document.title)}</title>
<link rel="icon" href="data:,">
{head}
</head>
<body>
<div id="viewer"><noscript><p>{escape(document.title)}: this page is drawn by a script, and scripts
are switched off in this browser.</p></noscript></div>
{DOCUMENT_START}{embedded_json(document)}{DOCUMENT_END}
{end}
</body>
</html>
"""


def embedded_json(document: AnyDocument) -> str:
    """JSON of a document inside a script element, which no text in it can end."""
    value = document.model_dump(mode="json")
    text = json.dumps(value, ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    for sign in "<>&\u2028\u2029":
        text = text.replace(sign, f"\\u{ord(sign):04x}")
    return text
