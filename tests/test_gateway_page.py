"""The front page names every module that its first one needs, and an answer of two parts does not wait."""

from __future__ import annotations

import re
import socket
from pathlib import Path

from dvsviz.gateway.app import _listen, static_folder
from dvsviz.gateway.page import front_page, modules


def test_every_module_is_named_once() -> None:
    static = static_folder()
    page = front_page(static)
    named = re.findall(r'rel="modulepreload" href="/static/([\w-]+\.js)"', page)
    assert named == sorted(set(named))
    assert page.index(named[0]) < page.index('src="/static/main.js"')
    imported = {
        name
        for module in [*named, "main.js"]
        for name in re.findall(r'from "\./([\w-]+\.js)"', (static / module).read_text())
    }
    assert imported - {"main.js"} == set(named)


def test_modules_of_modules_are_found(tmp_path: Path) -> None:
    (tmp_path / "a.js").write_text('import { b } from "./b.js";\nimport "./c.js";\n')
    (tmp_path / "b.js").write_text('import {\n  c,\n} from "./c.js";\nexport { d } from "./d.js";\n')
    (tmp_path / "c.js").write_text('const text = "./none.js";\n')
    (tmp_path / "d.js").write_text('import { a } from "./a.js";\n')
    assert modules(tmp_path, "a.js") == ["b.js", "c.js", "d.js"]


def test_what_is_answered_is_sent_at_once() -> None:
    with _listen("127.0.0.1", 0) as listener:
        # What asyncio looks at before it turns the waiting for a full packet off.
        assert listener.proto == socket.IPPROTO_TCP
        with socket.create_connection(listener.getsockname()):
            taken, _ = listener.accept()
            with taken:
                assert taken.proto == socket.IPPROTO_TCP
