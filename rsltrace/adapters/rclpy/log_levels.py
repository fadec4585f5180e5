"""The levels of loggers, by the rules of rcutils."""

from __future__ import annotations

LEVELS = {"UNSET": 0, "DEBUG": 10, "INFO": 20, "WARN": 30, "ERROR": 40, "FATAL": 50}


class LogLevels:
    """The levels that are set, by the names of loggers; the logger "" stands for all."""

    def __init__(self) -> None:
        self._levels: dict[str, int] = {}

    def reset(self) -> None:
        self._levels.clear()

    def set(self, name: str, level: int) -> None:
        """Set the level of a logger; UNSET takes it back.

        :raises ValueError: if there is no such level.
        """
        if not 0 <= level <= LEVELS["FATAL"]:
            raise ValueError("Invalid severity level specified for logger")
        if level not in LEVELS.values():
            raise ValueError("Unable to determine severity_string for severity")
        self._levels[name] = level

    def get(self, name: str) -> int:
        """Return the level that was set for a logger itself, UNSET if none was."""
        return self._levels.get(name, 0 if name else LEVELS["INFO"])

    def effective(self, name: str) -> int:
        """Return the level of a logger: its own, that of the next one above it, or the default."""
        while name:
            if level := self._levels.get(name, 0):
                return level
            name = name.rpartition(".")[0]
        return self.get("")
