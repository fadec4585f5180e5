"""What the person who starts the server allows. No tool has an argument that changes it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


class RefusedError(Exception):
    """A call that is not allowed, or cannot be made; the text says what can be done."""


@dataclass(frozen=True, slots=True)
class Access:
    """The folders in which files may be read and written, and whether nodes may run.

    ``folders`` are resolved; names of files are relative to the first. ``limit_s`` is how long a
    call may take.
    """

    folders: tuple[Path, ...]
    trust: bool
    limit_s: float

    def path(self, name: str) -> Path:
        """Return the file or folder of a name, after all links.

        :raises RefusedError: it is outside of the folders.
        """
        try:
            found = (self.folders[0] / name).resolve()
        except (OSError, ValueError, RuntimeError) as error:  # loops of links, null bytes
            raise RefusedError(f"{name!r} is no name of a file: {error}") from None
        if not any(found.is_relative_to(folder) for folder in self.folders):
            allowed = ", ".join(map(str, self.folders))
            raise RefusedError(
                f"{name!r} is outside of {allowed}. Only the person who starts the server can "
                "allow another folder: rsltrace mcp --folder DIR"
            )
        return found

    def existing(self, name: str) -> Path:
        """Return the same of what must exist."""
        found = self.path(name)
        if not found.exists():
            raise RefusedError(f"there is no {name!r} in {self.folders[0]}")
        for inside in found.iterdir() if found.is_dir() else ():  # of a bag
            self.path(str(inside))
        return found

    def new_trace(self, name: str) -> Path:
        """Return where to write a trace. Nothing else is replaced by one."""
        if not name.endswith(".mcap"):
            raise RefusedError(f"{name!r}: the name of a trace ends with .mcap")
        return self.path(name)

    def require_trust(self) -> None:
        """Refuse to run nodes unless the command line says so."""
        if not self.trust:
            raise RefusedError(
                "this runs code that a job or trace names, which needs trust. Only the person who "
                "starts the server can give it: rsltrace mcp --trust. Without it: overview, "
                "events, event, why (of an event), diff, latency."
            )
