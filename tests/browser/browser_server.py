"""The real program, started and stopped as a user does."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import threading
from pathlib import Path

START_S = 60.0
PROGRAM = [sys.executable, "-m", "dvsviz", "serve"]


class served:
    """The program as a user starts it, stopped as a user stops it."""

    def __init__(self, folder: Path, cache: Path, *arguments: Path | str) -> None:
        environment = {**os.environ, "DVSVIZ_CACHE": str(cache), "PYTHONUNBUFFERED": "1"}
        command = [*PROGRAM, *map(str, arguments), "--sessions", str(folder), "--no-browser", "--port", "0"]
        self.process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment
        )
        self.said: list[str] = []

    def __enter__(self) -> str:
        address: list[str] = []
        ready = threading.Event()

        def read() -> None:
            for line in self.process.stdout or ():
                self.said.append(line)
                if re.match("http", line):
                    address.append(line.strip())
                    ready.set()
            ready.set()

        self.readers = [
            threading.Thread(target=read, daemon=True),
            threading.Thread(target=lambda: self.said.extend(self.process.stderr or ()), daemon=True),
        ]
        for reader in self.readers:
            reader.start()
        ready.wait(START_S)
        if not address:
            self.process.kill()
            raise AssertionError(f"the server printed no address: {self.said}")
        return address[0]

    def __exit__(self, *_: object) -> None:
        self.process.terminate()
        try:
            self.process.wait(20)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        for reader in self.readers:
            reader.join(5)
        for stream in (self.process.stdout, self.process.stderr):
            if stream:
                stream.close()
