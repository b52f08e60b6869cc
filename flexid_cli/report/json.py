"""The report as JSON: full precision, the same bytes for the same document."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Mapping


def render_json(document: Mapping[str, Any]) -> str:
    """Write the document as JSON text in its own key order, ending in a newline.

    Raises
    ------
    ValueError
        The document holds NaN or infinity; `build_document` never makes one.
    """
    return json.dumps(document, indent=2, ensure_ascii=False, allow_nan=False) + "\n"
