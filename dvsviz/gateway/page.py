"""The front page as it is sent: it names all of its modules, so that the browser asks for them together.

Without that, each module is asked for when the one that imports it has come: five journeys instead of two.
"""

from __future__ import annotations

import re
from pathlib import Path

_IMPORT = re.compile(r"""^(?:import|export)\b[^;]*?["']\./([\w-]+\.js)["']""", re.MULTILINE)
_ENTRY = '<script type="module" src="/static/main.js"></script>'


def front_page(static: Path) -> str:
    """Return `index.html` of the folder of the page's files, its modules named before the first one."""
    named = "".join(f'<link rel="modulepreload" href="/static/{name}">\n  ' for name in modules(static, "main.js"))
    return (static / "index.html").read_text(encoding="utf-8").replace(_ENTRY, named + _ENTRY)


def modules(static: Path, first: str) -> list[str]:
    """Return the modules that one imports, and those that they import, each once, without the first one."""
    found, left = {first}, [first]
    while left:
        imported = _IMPORT.findall((static / left.pop()).read_text(encoding="utf-8"))
        new = [name for name in imported if name not in found]
        found.update(new)
        left += new
    return sorted(found - {first})
