"""A folder or a zip archive of named files, read the same way, with a limit on what an archive may unpack to."""

from __future__ import annotations

import zipfile
import zlib
from pathlib import Path, PurePosixPath
from typing import BinaryIO, Protocol, cast

from dvsviz.errors import FormatError

# Text events compress five- to twentyfold. An archive that grows more than this is not a recording.
_MAX_RATIO = 200
_RATIO_FREE_BYTES = 64 << 20
_MAX_ENTRIES = 1_000_000


class Container(Protocol):
    """Named files that belong together."""

    @property
    def path(self) -> Path:
        """The folder or archive."""
        ...

    def has(self, name: str) -> bool:
        """Return whether there is such a file."""
        ...

    def size(self, name: str) -> int:
        """Return the number of bytes of a file."""
        ...

    def open(self, name: str) -> BinaryIO:
        """Open a file for reading."""
        ...

    def where(self, name: str) -> Path:
        """Return how a file is named in errors."""
        ...


class Folder:
    """A `Container` over a folder; names cannot lead out of it."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def has(self, name: str) -> bool:
        """Return whether there is such a file."""
        return self.where(name).is_file()

    def size(self, name: str) -> int:
        """Return the number of bytes of a file."""
        return self.where(name).stat().st_size

    def open(self, name: str) -> BinaryIO:
        """Open a file for reading."""
        try:
            return self.where(name).open("rb")
        except OSError as error:
            raise FormatError(f"cannot be read: {error.strerror}", path=self.where(name)) from error

    def where(self, name: str) -> Path:
        """Return the path of a file.

        Raises:
            FormatError: the name leads out of the folder.
        """
        if PurePosixPath(name).is_absolute() or ".." in PurePosixPath(name).parts:
            raise FormatError(f"the name {name!r} leads out of the folder", path=self.path, hint="correct the name")
        return self.path / name


class Zip:
    """A `Container` over a zip archive; one folder around everything is looked through.

    Raises:
        FormatError: not a whole zip archive, or one that unpacks to an absurd size.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self._zip = zipfile.ZipFile(path)
        except (zipfile.BadZipFile, OSError, NotImplementedError, ValueError) as error:
            reason = "not a whole zip archive"
            raise FormatError(reason, path=path, hint="it was cut short or damaged: copy it again") from error
        entries = [entry for entry in self._zip.infolist() if not entry.is_dir()]
        if len(entries) > _MAX_ENTRIES:
            raise FormatError(f"{len(entries)} files inside", path=path, hint="this is not a recording")
        self._budget = _MAX_RATIO * path.stat().st_size + _RATIO_FREE_BYTES
        if sum(entry.file_size for entry in entries) > self._budget:
            message = f"it would unpack to more than {_MAX_RATIO} times its size"
            raise FormatError(message, path=path, hint="unpack it yourself if you trust it, and open the folder")
        tops = {entry.filename.split("/")[0] + "/" for entry in entries}
        prefix = tops.pop() if len(tops) == 1 else ""
        if any(not entry.filename.startswith(prefix) for entry in entries):
            prefix = ""
        self._entries = {entry.filename.removeprefix(prefix): entry for entry in entries}

    @property
    def names(self) -> list[str]:
        """Names of all files."""
        return list(self._entries)

    def has(self, name: str) -> bool:
        """Return whether there is such a file."""
        return name in self._entries

    def size(self, name: str) -> int:
        """Return the number of bytes of a file, unpacked."""
        return self._entries[name].file_size

    def open(self, name: str) -> BinaryIO:
        """Open a file for reading; damage shows as a `FormatError` while it is read."""
        try:
            return cast(BinaryIO, _Checked(self._zip.open(self._entries[name]), self.where(name)))
        except (zipfile.BadZipFile, OSError, NotImplementedError, RuntimeError) as error:
            reason = f"this file of the archive cannot be read ({error})"
            raise FormatError(reason, path=self.where(name), hint="copy or pack it again") from error

    def where(self, name: str) -> Path:
        """Return the archive's path followed by the name."""
        return self.path / name

    def close(self) -> None:
        """Close the archive."""
        self._zip.close()


class _Checked:
    """A file of an archive whose damage is told as a `FormatError`."""

    def __init__(self, file: BinaryIO | object, path: Path) -> None:
        self._file, self._path = cast(BinaryIO, file), path

    def read(self, size: int = -1) -> bytes:
        try:
            return self._file.read(size)
        except (zipfile.BadZipFile, zlib.error, EOFError, OSError) as error:
            reason = "this file of the archive is damaged or cut short"
            raise FormatError(reason, path=self._path, hint="copy or pack it again") from error

    def close(self) -> None:
        self._file.close()

    def __enter__(self) -> _Checked:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
