"""The HTML skeleton of every report: one file that works from disk and asks for nothing from outside."""

from __future__ import annotations

from html import escape

STYLE = """body{font:15px/1.5 system-ui,sans-serif;color:#1f2328;max-width:67rem;margin:2rem auto;padding:0 1rem}
table{border-collapse:collapse;margin:.5rem 0}
td,th{padding:.2rem .7rem;border-bottom:1px solid #d0d7de;text-align:right}
td:first-child,th:first-child{text-align:left}
img{max-width:100%}
"""


def html_page(title: str, body: str, *, style: str = "", beside: bool = False) -> str:
    """`body` (HTML) as a page. style : CSS after the common one. beside : pictures are files next to the page."""
    pictures = "data: file: 'self'" if beside else "data:"
    policy = f"default-src 'none'; style-src 'unsafe-inline'; img-src {pictures}"
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">'
        f"<title>{escape(title)}</title><style>{STYLE}{style}</style></head><body>{body}</body></html>\n"
    )
