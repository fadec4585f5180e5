"""Addresses of files elsewhere, and what of them may be said in errors and reports."""

from __future__ import annotations

import re
from urllib.parse import unquote, urlsplit

_SIGNS_MIN = 3
"""Shorter pieces of an address are not taken out of texts: they would be found in any word."""

_ADDRESS = re.compile(r"[A-Za-z][A-Za-z0-9+.-]*://[^\s'\"<>)\]}]+")


def public(address: str) -> str:
    """Return an address without user name, password, query (signed ones give access) and fragment.

    An ellipsis stands for a query, so that nobody takes what is shown for the whole.
    """
    address = re.sub(r"(?<=://)[^/?#]*@", "", address.partition("#")[0])
    plain, query, _ = address.partition("?")
    return f"{plain}?…" if query else plain


def without_secrets(text: str, address: str) -> str:
    """Return ``text``, which a library may have made of ``address``, with what is public of it."""
    text = _ADDRESS.sub(lambda found: public(found[0]), text.replace(address, public(address)))
    try:
        parts = urlsplit(address)
    except ValueError:  # no address at all
        return text
    pieces = re.split(r"[&=:]", f"{parts.query}&{parts.netloc.rpartition('@')[0]}&{parts.fragment}")
    for piece in sorted({*pieces, *map(unquote, pieces)}, key=len, reverse=True):
        if len(piece) >= _SIGNS_MIN:
            text = text.replace(piece, "…")
    return text
