"""The house plan, held: who may import whom, third-party homes, sizes, and what tracked files may not say."""

from __future__ import annotations

import ast
import re
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "dvsviz"

# Top floor first; rooms in one row stand side by side and do not know each other.
FLOORS: tuple[frozenset[str], ...] = tuple(
    frozenset(row.split())
    for row in (
        "app",
        "__init__ __main__",
        "cli",
        "gateway",
        "pipeline",
        "export",
        "view",
        "tracking",
        "registration",
        "simulate",
        "formats live",
        "contrast",
        "evaluate",
        "session",
        "events",
        "geometry",
        "config",
        "errors",
    )
)
DEPTH = {room: depth for depth, row in enumerate(FLOORS) for room in row}

# What a room does not know although it lies below.
STRANGERS = {
    "tracking": {"registration", "simulate", "formats", "live", "export", "evaluate"},
    "view": {"tracking", "registration", "simulate"},
}

HOMES = {
    "viser": {"view"},
    "rerun": {"export"},
    "h5py": {"session", "formats"},
    "tyro": {"cli"},
    "rich": {"app", "cli"},
}


def python_files() -> list[Path]:
    return [*sorted(PACKAGE.rglob("*.py")), *sorted(ROOT.glob("app.py"))]


def room_of(path: Path) -> str:
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py") if path.is_relative_to(PACKAGE) else "app"


def imported_modules(tree: ast.AST) -> Iterator[tuple[str, int]]:
    """Yield all imported module names with their line, those inside functions too."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((alias.name, node.lineno) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"line {node.lineno}: imports are absolute here"
            module = node.module or ""
            yield module, node.lineno
            if module == "dvsviz":
                yield from ((f"dvsviz.{alias.name}", node.lineno) for alias in node.names)


def broken_imports(room: str, source: str) -> list[str]:
    """Return a sentence for each import that goes up, sideways or to a stranger, or leaves its home."""
    found = []
    for name, line in imported_modules(ast.parse(source)):
        top, *rest = name.split(".")
        if top == "dvsviz":
            other = rest[0] if rest else "__init__"
            below = other == room or DEPTH.get(other, -1) > DEPTH[room]
            if other in DEPTH and other != "__init__" and not below:
                found.append(f"line {line}: {room} imports {other}, which is not below it")
            if other in STRANGERS.get(room, set()):
                found.append(f"line {line}: {room} does not know {other}")
            if rest and other not in DEPTH and (PACKAGE / other).exists():
                found.append(f"line {line}: {other} has no floor in this test")
        elif top in HOMES and room not in HOMES[top]:
            found.append(f"line {line}: {top} lives in {', '.join(sorted(HOMES[top]))}, not in {room}")
    return found


def tracked(*patterns: str) -> list[Path]:
    run = subprocess.run(
        ["git", "ls-files", "-z", "--", *patterns], cwd=ROOT, capture_output=True, text=True, check=True
    )
    return [ROOT / name for name in run.stdout.split("\0") if name and (ROOT / name).is_file()]


def text_files() -> Iterator[tuple[Path, str]]:
    for path in tracked():
        data = path.read_bytes()
        if b"\0" not in data[:8192]:
            yield path, data.decode("utf-8")


def test_every_room_has_a_floor() -> None:
    for path in python_files():
        assert room_of(path) in DEPTH, f"{path.relative_to(ROOT)}: say in this test on which floor it stands"


def test_imports_only_go_down() -> None:
    wrong = [
        f"{path.relative_to(ROOT)}, {sentence}"
        for path in python_files()
        for sentence in broken_imports(room_of(path), path.read_text(encoding="utf-8"))
    ]
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize(
    ("room", "source"),
    [
        ("geometry", "from dvsviz.events.events import Events"),
        ("formats", "import dvsviz.live.network"),
        ("events", "def f():\n    from dvsviz.session import store"),
        ("tracking", "from dvsviz import evaluate"),
        ("view", "from dvsviz.tracking.tracker import Tracker"),
        ("gateway", "import viser.transforms"),
        ("contrast", "import h5py"),
        ("pipeline", "import rerun as rr"),
    ],
)
def test_the_check_sees_a_wrong_import(room: str, source: str) -> None:
    assert broken_imports(room, source)


def test_the_check_lets_right_imports_pass() -> None:
    assert not broken_imports("tracking", "from dvsviz.contrast.iwe import x\nfrom dvsviz.tracking import align")
    assert not broken_imports(
        "cli", "import tyro\nfrom dvsviz import __version__\nfrom dvsviz.pipeline import track"
    )


def test_files_stay_readable() -> None:
    long = {
        str(path.relative_to(ROOT)): lines
        for path in python_files()
        if (lines := len(path.read_text(encoding="utf-8").splitlines())) > 400
    }
    assert not long, f"more than 400 lines: {long}; which noun is missing?"


def test_no_file_is_named_for_leftovers() -> None:
    for path in python_files():
        assert path.stem not in {"utils", "util", "helpers", "common", "misc"}, path


def test_only_the_command_line_prints_and_exits() -> None:
    for path in python_files():
        if room_of(path) in {"cli", "__main__", "app"}:
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call):
                called = ast.unparse(node.func)
                assert called not in {"print", "exit", "quit", "sys.exit", "os._exit"}, (
                    f"{path.relative_to(ROOT)}, line {node.lineno}: {called}"
                )


def test_values_are_frozen() -> None:
    """A dataclass that can be changed in place is state, and state lives in few places."""
    for path in python_files():
        if room_of(path) == "tracking":
            continue  # the tracker remembers things between windows: the one room that holds state
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ClassDef):
                for mark in node.decorator_list:
                    text = ast.unparse(mark)
                    if text.startswith(("dataclass", "dataclasses.dataclass")):
                        for word in ("frozen=True", "slots=True", "kw_only=True"):
                            assert word in text, f"{path.relative_to(ROOT)}, {node.name}: {word} is missing"


# Written in pieces, so that this file does not hold what it looks for.
PRIVATE = re.compile("|".join([r"/work" + "/", r"/root" + "/", r"/home/" + r"[a-z]", r"/Users/" + r"[A-Za-z]"]))
REGISTRIES = re.compile(
    "|".join([r"--(extra-)?index" + "-url", "--find" + "-links", "artifact" + "ory"]), re.IGNORECASE
)


def test_no_tracked_text_names_a_machine() -> None:
    wrong = [
        f"{path.relative_to(ROOT)}, line {number}: {line.strip()[:100]}"
        for path, text in text_files()
        for number, line in enumerate(text.splitlines(), 1)
        if PRIVATE.search(line) or REGISTRIES.search(line)
    ]
    assert not wrong, "\n".join(wrong)


# A namespace is a name, not an address that is fetched.
# The page's own address on the user's machine is shown as an example of what to paste.
NAMESPACES = (
    "http://www.w3.org/2000/svg",
    "http://www.w3.org/1999/xhtml",
    "http://www.w3.org/1999/xlink",
    "http://127.0.0.1",
)
EXTERNAL = re.compile(r"(?:https?|wss?):\\?/\\?/\w|(?:src|href|url|import)\s*[=(]?\s*[\"'(]\s*//\w", re.IGNORECASE)


def external_addresses(text: str) -> list[str]:
    for name in NAMESPACES:
        text = text.replace(name, "")
    return [line.strip()[:120] for line in text.splitlines() if EXTERNAL.search(line)]


def test_the_page_fetches_nothing_from_elsewhere() -> None:
    for path in sorted((ROOT / "static").rglob("*")):
        if path.suffix in {".html", ".css", ".js", ".svg", ".json", ".webmanifest"}:
            found = external_addresses(path.read_text(encoding="utf-8"))
            assert not found, f"{path.relative_to(ROOT)}: {found}"


@pytest.mark.parametrize(
    "line",
    [
        '<script src="https://cdn.example/x.js">',
        "url(//fonts.example/a)",
        '<a href="//x.example">',
        "wss://x.example",
    ],
)
def test_the_check_sees_an_external_address(line: str) -> None:
    assert external_addresses(line)


def test_large_or_foreign_files_are_not_tracked() -> None:
    for path in tracked():
        assert path.stat().st_size < 2 * 1024 * 1024, f"{path.relative_to(ROOT)} is larger than 2 MiB"
        assert path.suffix not in {".aedat4", ".bag", ".raw", ".dat", ".whl", ".rrd"}, path
