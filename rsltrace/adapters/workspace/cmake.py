"""The commands of a package's ``CMakeLists.txt`` with their variables expanded, as far as nothing
has to be configured for it.

CMake is not run: that takes the packages of ``find_package``, a compiler and a build folder. What
the language itself says is followed: ``set``, ``list``, ``string``, ``file(GLOB)``, ``foreach``,
``function``, ``macro``, ``if`` with what is known, ``add_subdirectory`` and ``include``. A variable
that nobody here has set stays in the text (``${NAME}``); the branches of an ``if`` that depends on
one are all followed. Rejected: an empty text for it, as CMake has it, since what a package found
may well have set it.
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from glob import glob
from itertools import pairwise
from math import comb
from pathlib import Path

from rsltrace.source_packages import SourcePackage

_COMMANDS_MAX = 20_000
"""What a file may come to: a recursion has no end of its own."""
_CHARACTERS_MAX = 20_000_000
"""How long the values that it uses may be in all: a list may double in each line. Other work is
counted in such characters, too."""
_TEXT_MAX = 1_000_000
_GLOB_CHARACTERS, _SKIPPED_CHARACTERS = 20_000, 10
_FREE_MAX, _PATTERN_MAX = 4, 1000
_STEPS_PER_CHARACTER = 50
"""Steps of a regular expression that take as long as using a character does."""
_BLOCKS_MAX = 30
_CONDITION_WORDS_MAX = 100
# What is not closed goes on to the end, so that no part of a text is looked through twice.
_TOKEN = re.compile(
    r"""(?P<space>[\s;]+)|\#\[(?P<comment_mark>=*)\[.*?(?:\](?P=comment_mark)\]|\Z)
    |(?P<comment>\#[^\n]*)|\[(?P<mark>=*)\[\n?(?P<bracket>.*?)(?:\](?P=mark)\]|\Z)
    |"(?P<quoted>(?:[^"\\]+|\\.?)*)(?:"|\Z)|(?P<parenthesis>[()])
    |(?P<plain>(?:[^\s;()"#\\$]+|\\.|\$\{[^}\s]*\}?|\$<[^>\s]*>?|\$)+)|(?P<odd>.)""",
    re.VERBOSE | re.DOTALL,
)
_COMMAND = re.compile(r"([A-Za-z_]\w*)[ \t\n]*\(")
_BRACES = re.compile(r"(\\.|\$\w*\{|\})", re.DOTALL)
_UNKNOWN = re.compile(r"\$(?:ENV)?\{[^}]*\}?|\$<")
_FALSE = frozenset(("", "0", "OFF", "NO", "FALSE", "N", "IGNORE", "NOTFOUND"))
_TRUE = frozenset(("1", "ON", "YES", "TRUE", "Y"))
_ENDS = {"if": "endif", "foreach": "endforeach", "while": "endwhile", "block": "endblock"}
_ENDS |= {name: f"end{name}" for name in ("function", "macro")}
_LIBRARIES = f"lib/python{sys.version_info[0]}.{sys.version_info[1]}/site-packages"


@dataclass(frozen=True, slots=True)
class _Word:
    """An argument of a command; a ``quoted`` one is a single word whatever is in it."""

    text: str
    quoted: bool = False


@dataclass(frozen=True, slots=True)
class _WrittenCommand:
    """A command as it is written."""

    name: str
    words: tuple[_Word, ...]
    file: Path
    line: int


@dataclass(frozen=True, slots=True)
class CMakeCommand:
    """A command with its arguments expanded; paths in them are relative to ``folder``."""

    name: str
    words: tuple[str, ...]
    folder: Path
    place: str
    """``CMakeLists.txt:12``."""

    def unknown(self, words: Sequence[str] | None = None) -> str | None:
        """Say which of the words could not be expanded, and where; None if there is none."""
        for word in self.words if words is None else words:
            if found := _UNKNOWN.search(word):
                name = found[0] if found[0] != "$<" else f"the generator expression {word}"
                return f"{self.place}: {name} is not known before the package is configured"
        return None


def is_expanded(word: str) -> bool:
    """Return whether a word has no reference left to what is not known."""
    return _UNKNOWN.search(word) is None


def commands(package: SourcePackage) -> list[CMakeCommand]:
    """Return what the ``CMakeLists.txt`` of a package and the files that it includes call."""
    evaluation = _CMakeInterpreter(package)
    evaluation.run_file(package.folder / "CMakeLists.txt")
    return evaluation.found


def _read(file: Path) -> list[_WrittenCommand]:
    """Return the commands of a file; nothing if it cannot be read. Its text may be anything: what
    is not a command is passed over."""
    try:
        with file.open(encoding="utf-8", errors="replace") as opened:
            text = opened.read(_TEXT_MAX)
    except OSError:
        return []
    found = []
    position, counted, line = 0, 0, 1
    while match := _next_command(text, position):
        words, position = _arguments(text, match.end())
        line += text.count("\n", counted, match.start())
        counted = match.start()
        found.append(_WrittenCommand(match[1].lower(), tuple(words), file, line))
    return found


def _next_command(text: str, position: int) -> re.Match[str] | None:
    """Find the next command, past spaces, comments and whatever else is between two."""
    while position < len(text):
        if match := _COMMAND.match(text, position):
            return match
        token = _TOKEN.match(text, position)
        position = position + 1 if token is None else token.end()
    return None


def _arguments(text: str, position: int) -> tuple[list[_Word], int]:
    """Return the words up to the parenthesis that closes the command, and where it ends."""
    words: list[_Word] = []
    depth = 1
    while depth and (token := _TOKEN.match(text, position)):
        position = token.end()
        kind = token.lastgroup
        if kind == "parenthesis":
            depth += 1 if token[0] == "(" else -1
            if depth:
                words.append(_Word(token[0]))
        elif kind == "quoted":
            words.append(_Word(token["quoted"], quoted=True))
        elif token["bracket"] is not None:
            words.append(_Word(token["bracket"].replace("$", "\\$"), quoted=True))
        elif kind == "plain":
            words.append(_Word(token[0]))
    return words, position


@dataclass
class _VariableScope:
    """Variables, and what is visible around them."""

    values: dict[str, str] = field(default_factory=dict)
    outer: _VariableScope | None = None

    def get(self, name: str) -> str | None:
        """Return a value, None if there is none."""
        scope: _VariableScope | None = self
        while scope is not None:
            if name in scope.values:
                return scope.values[name]
            scope = scope.outer
        return None

    @contextmanager
    def restored(self, names: Iterable[str]) -> Iterator[None]:
        """Give these variables the values afterwards that they have now."""
        before = {name: self.values.get(name) for name in names}
        yield
        for name, value in before.items():
            self.values.pop(name, None)
            if value is not None:
                self.values[name] = value


class _CMakeInterpreter:
    """Follows the commands of one package."""

    def __init__(self, package: SourcePackage) -> None:
        self.found: list[CMakeCommand] = []
        self._top = package.folder
        self._folder = package.folder
        self._functions: dict[str, tuple[_WrittenCommand, list[_WrittenCommand]]] = {}
        self._depth = 0
        self._left = _COMMANDS_MAX
        self._characters_left = _CHARACTERS_MAX
        self._blocks = 0
        here = str(package.folder)
        own = ("CMAKE_CURRENT_SOURCE_DIR", "PROJECT_SOURCE_DIR", "CMAKE_SOURCE_DIR")
        self._scope = _VariableScope(
            {
                **dict.fromkeys((*own, "CMAKE_CURRENT_LIST_DIR"), here),
                **dict.fromkeys(("PROJECT_NAME", "CMAKE_PROJECT_NAME"), package.name),
                "CMAKE_CURRENT_LIST_FILE": f"{here}/CMakeLists.txt",
                "CMAKE_INSTALL_PREFIX": "",
                "CMAKE_INSTALL_LIBDIR": "lib",
                "CMAKE_INSTALL_BINDIR": "bin",
                "CMAKE_INSTALL_DATADIR": "share",
                "PYTHON_INSTALL_DIR": _LIBRARIES,
            }
        )

    def run_file(self, file: Path) -> None:
        """Follow the commands of a file."""
        if self._depth < 20:
            self._depth += 1
            self._run(_read(file))
            self._depth -= 1

    # -- blocks ----------------------------------------------------------------------------------

    def _run(self, calls: Sequence[_WrittenCommand]) -> None:
        index = 0
        while index < len(calls) and self._left > 0:
            self._left -= 1
            call = calls[index]
            index += 1
            if call.name in _ENDS:
                end = _end_of(calls, index, call.name)
                self._may_use(_SKIPPED_CHARACTERS * (end - index))
                self._block(call, list(calls[index:end]))
                index = end + 1
            else:
                self._call(call)

    def _block(self, call: _WrittenCommand, body: list[_WrittenCommand]) -> None:
        if self._blocks < _BLOCKS_MAX:
            self._blocks += 1
            self._enter(call, body)
            self._blocks -= 1

    def _enter(self, call: _WrittenCommand, body: list[_WrittenCommand]) -> None:
        if call.name == "if":
            for part in self._branches(call, body):
                self._run(part)
        elif call.name == "foreach":
            self._foreach(call, body)
        elif call.name in ("function", "macro") and call.words:
            self._functions[call.words[0].text.lower()] = (call, body)
        elif call.name == "block":
            self._run(body)

    def _branches(
        self, call: _WrittenCommand, body: list[_WrittenCommand]
    ) -> Iterator[list[_WrittenCommand]]:
        """Give the branches that may be taken: up to the first one that certainly is."""
        heads: list[tuple[_WrittenCommand, list[_WrittenCommand]]] = [(call, [])]
        depth = 0
        for one in body:
            depth += (one.name in _ENDS) - (one.name in _ENDS.values())
            if depth == 0 and one.name in ("elseif", "else"):
                heads.append((one, []))
            else:
                heads[-1][1].append(one)
        for head, part in heads:
            self._left -= 1
            holds = True if head.name == "else" else self._holds(list(head.words))
            if holds is not False:
                yield part
            if holds:
                return

    def _foreach(self, call: _WrittenCommand, body: list[_WrittenCommand]) -> None:
        words = self._expanded(call.words)
        if not words:
            return
        name, rest = words[0], words[1:]
        if rest[:1] == ["IN"]:
            kind, rest = rest[1:2], rest[2:]
            items = rest
            if kind == ["LISTS"]:
                lists = rest[: rest.index("ITEMS")] if "ITEMS" in rest else rest
                items = [one for own in lists for one in self._list(own)]
                items += rest[len(lists) + 1 :]
        elif rest[:1] == ["RANGE"]:
            return
        else:
            items = rest
        with self._scope.restored([name]):
            for item in items:
                self._scope.values[name] = item
                self._run(body)

    # -- commands --------------------------------------------------------------------------------

    def _call(self, call: _WrittenCommand) -> None:
        words = self._expanded(call.words)
        if call.name in self._functions:
            self._call_function(call.name, words)
            return
        known = getattr(self, f"_do_{call.name}", None)
        if known is not None:
            if words:
                known(words)
            return
        name = _below(call.file, self._top)
        self.found.append(
            CMakeCommand(call.name, tuple(words), self._folder, f"{name}:{call.line}")
        )

    def _call_function(self, name: str, words: list[str]) -> None:
        """Call what the package defines; a macro's variables are those of its caller, too."""
        head, body = self._functions[name]
        parameters = [word.text for word in head.words[1:]]
        given = dict(zip(parameters, words, strict=False))
        given |= {f"ARGV{index}": word for index, word in enumerate(words)}
        given |= {"ARGV": ";".join(words), "ARGN": ";".join(words[len(parameters) :])}
        given["ARGC"] = str(len(words))
        if self._depth >= 20:
            return
        self._depth += 1
        outer = self._scope
        if head.name == "function":
            self._scope = _VariableScope(given, outer)
            self._run(body)
            self._scope = outer
        else:
            with outer.restored(given):
                outer.values |= given
                self._run(body)
        self._depth -= 1

    def _do_project(self, words: list[str]) -> None:
        for name in ("PROJECT_NAME", "CMAKE_PROJECT_NAME"):
            self._scope.values[name] = words[0]

    def _do_set(self, words: list[str]) -> None:
        name, values = words[0], words[1:]
        if name.startswith("ENV{"):
            return
        scope: _VariableScope | None = self._scope
        if values[-1:] == ["PARENT_SCOPE"]:
            values, scope = values[:-1], self._scope.outer
        if "CACHE" in values:
            values = values[: values.index("CACHE")]
        if scope is None:
            return
        if values:
            scope.values[name] = ";".join(values)
        else:
            scope.values.pop(name, None)

    def _do_unset(self, words: list[str]) -> None:
        self._scope.values.pop(words[0], None)

    def _do_option(self, words: list[str]) -> None:
        if self._scope.get(words[0]) is None:
            self._scope.values[words[0]] = words[2] if len(words) > 2 else "OFF"

    def _do_list(self, words: list[str]) -> None:
        if len(words) < 2:
            return
        kind, name, rest = words[0].upper(), words[1], words[2:]
        if kind in ("SORT", "REVERSE", "REMOVE_DUPLICATES"):
            return  # what is installed has no order
        items = self._list(name)
        if kind == "APPEND":
            items += rest
        elif kind == "PREPEND":
            items = rest + items
        elif kind == "REMOVE_ITEM":
            removed = set(rest)
            items = [one for one in items if one not in removed]
        elif kind == "FILTER" and len(rest) == 3:
            matches = [self._matches(rest[2], one) for one in items]
            if None in matches:
                self._forget(name)
                return
            wanted_is = rest[0] == "INCLUDE"
            items = [one for one, found in zip(items, matches, strict=True) if found is wanted_is]
        else:
            self._forget_all(words)
            return
        self._scope.values[name] = ";".join(items)

    def _do_string(self, words: list[str]) -> None:
        kind, rest = words[0].upper(), words[1:]
        if kind in ("TOLOWER", "TOUPPER") and len(rest) == 2:
            self._scope.values[rest[1]] = rest[0].lower() if kind == "TOLOWER" else rest[0].upper()
        elif kind == "REPLACE" and len(rest) >= 4:
            text = "".join(rest[3:])
            if self._may_use(text.count(rest[0]) * len(rest[1])):
                self._scope.values[rest[2]] = text.replace(rest[0], rest[1])
        else:
            self._forget_all(words)

    def _do_file(self, words: list[str]) -> None:
        kind, rest = words[0].upper(), words[1:]
        if kind not in ("GLOB", "GLOB_RECURSE") or not rest:
            return
        name, rest = rest[0], [one for one in rest[1:] if one != "CONFIGURE_DEPENDS"]
        base: Path | None = None
        if rest[:1] == ["RELATIVE"] and len(rest) > 1:
            base, rest = self._folder / rest[1], rest[2:]
        if rest[:1] == ["LIST_DIRECTORIES"]:
            rest = rest[2:]
        if not all(map(is_expanded, rest)):
            self._forget(name)
            return
        files = set[Path]()
        for pattern in rest:
            place = Path(os.path.normpath(self._folder / pattern))
            if not place.is_relative_to(self._top):
                continue  # all of the machine may be there
            if not self._may_use(_GLOB_CHARACTERS):
                return
            if kind == "GLOB":
                files |= {Path(one) for one in glob(str(place))}
            else:
                files |= {one for one in place.parent.rglob(place.name) if one.is_file()}
        found = sorted(files)
        texts = (str(one if base is None else _below(one, base)) for one in found)
        self._scope.values[name] = ";".join(texts)

    def _do_get_filename_component(self, words: list[str]) -> None:
        if len(words) < 3:
            return
        path = Path(words[1])
        name, _, endings = path.name.partition(".")
        values = {
            "NAME": path.name,
            "NAME_WE": name,
            "NAME_WLE": path.stem,
            "EXT": f".{endings}" if endings else "",
            "LAST_EXT": path.suffix,
            "DIRECTORY": str(path.parent) if str(path.parent) != "." else "",
            "ABSOLUTE": str(self._folder / path),
            "REALPATH": str(self._folder / path),
        }
        values["PATH"] = values["DIRECTORY"]
        value = values.get(words[2])
        if value is None or not is_expanded(words[1]):
            self._forget(words[0])
        else:
            self._scope.values[words[0]] = value

    def _do_add_subdirectory(self, words: list[str]) -> None:
        folder = self._folder / words[0]
        if not is_expanded(words[0]) or not (folder / "CMakeLists.txt").is_file():
            return
        outer, before = self._scope, self._folder
        here = dict.fromkeys(("CMAKE_CURRENT_SOURCE_DIR", "CMAKE_CURRENT_LIST_DIR"), str(folder))
        self._scope, self._folder = _VariableScope(here, outer), folder
        self.run_file(folder / "CMakeLists.txt")
        self._scope, self._folder = outer, before

    def _do_include(self, words: list[str]) -> None:
        file = self._folder / words[0]
        if is_expanded(words[0]) and file.is_file() and file.is_relative_to(self._top):
            with self._scope.restored(["CMAKE_CURRENT_LIST_DIR"]):
                self._scope.values["CMAKE_CURRENT_LIST_DIR"] = str(file.parent)
                self.run_file(file)

    # -- values ----------------------------------------------------------------------------------

    def _forget(self, name: str) -> None:
        """Let a variable be unknown from here on."""
        self._scope.values[name] = f"${{{name}}}"

    def _forget_all(self, words: Sequence[str]) -> None:
        """Let the variables that a command names be unknown: it may change any of them."""
        for word in words:
            if self._scope.get(word) is not None:
                self._forget(word)

    def _may_use(self, characters: int) -> bool:
        """Count characters of values; at the limit nothing more is followed."""
        self._characters_left -= characters
        if self._characters_left < 0:
            self._left = 0
        return self._left > 0

    def _value(self, name: str) -> str | None:
        """Return the value of a variable for use, None if there is none."""
        value = self._scope.get(name)
        return value if value is None or self._may_use(len(value)) else None

    def _list(self, name: str) -> list[str]:
        value = self._value(name)
        if value is None:
            return []
        return [one for one in value.split(";") if one]

    def _expanded(self, words: Sequence[_Word]) -> list[str]:
        """Return the words with their variables in them; an unquoted list is several words."""
        found: list[str] = []
        for word in words:
            text = _unescaped(self._filled(word.text))
            if word.quoted:
                found.append(text)
            else:
                found += [one for one in text.split(";") if one]
        return found

    def _filled(self, text: str) -> str:
        """Replace what is known, inner references first; the rest stays as it is.

        A value is not expanded again: one that holds a reference to itself (``set(X "${X} a")``
        with an X that nobody here has set) would grow with each use.
        """
        opened: list[str] = []
        parts: list[list[str]] = [[]]
        for token in _BRACES.split(text):
            if token[:1] == "$" and token[-1:] == "{":
                opened.append(token)
                parts.append([])
            elif token == "}" and opened:
                name, opening = "".join(parts.pop()), opened.pop()
                value = self._value(name) if opening == "${" else None
                parts[-1].append(f"{opening}{name}}}" if value is None else value)
            else:
                parts[-1].append(token)
        return "".join(
            begun + "".join(part) for begun, part in zip(("", *opened), parts, strict=True)
        )

    # -- conditions ------------------------------------------------------------------------------

    def _holds(self, words: list[_Word]) -> bool | None:
        """Return whether a condition holds, None if nobody knows."""
        if len(words) > _CONDITION_WORDS_MAX or any(
            word.text in ("(", ")") and not word.quoted for word in words
        ):
            return None
        for joint, decides in (("OR", True), ("AND", False)):
            places = [i for i, one in enumerate(words) if one == _Word(joint)]
            if places:
                parts = [words[a + 1 : b] for a, b in pairwise([-1, *places, len(words)])]
                holds = [self._holds(part) for part in parts]
                if decides in holds:
                    return decides
                return None if None in holds else not decides
        if words[:1] == [_Word("NOT")]:
            held = self._holds(words[1:])
            return None if held is None else not held
        return self._test([word.text if word.quoted else word for word in words])

    def _test(self, words: list[str | _Word]) -> bool | None:
        def filled(word: str | _Word) -> str:
            return self._filled(word.text if isinstance(word, _Word) else word)

        texts = [filled(word) for word in words]
        if not all(map(is_expanded, texts)):
            return None
        if len(texts) == 1:
            return self._truth(texts[0], is_plain=isinstance(words[0], _Word))
        if len(texts) == 2 and texts[0] == "EXISTS":
            return (self._folder / texts[1]).exists()
        if len(texts) == 2 and texts[0] == "DEFINED":
            return True if self._scope.get(texts[1]) is not None else None
        if len(texts) == 3 and texts[1] in ("STREQUAL", "MATCHES", "IN_LIST", "EQUAL"):
            left, right = self._scope.get(texts[0]) or texts[0], texts[2]
            if texts[1] == "IN_LIST":
                return left in self._list(right)
            right = self._scope.get(right) or right
            if not (is_expanded(left) and is_expanded(right)):
                return None
            if texts[1] != "MATCHES":
                return left == right
            return self._matches(right, left)
        return None

    def _matches(self, pattern: str, text: str) -> bool | None:
        """Return whether one of CMake's regular expressions is found in a text; None if Python has
        none of that kind, or if it may take long.

        Each repetition, and the place to begin at, may stop anywhere in the text. Groups must not
        be repeated: that may take for ever.
        """
        free = len(re.findall(r"[*+?{]", pattern)) + 1
        if free > _FREE_MAX or len(pattern) > _PATTERN_MAX or re.search(r"\)[*+?{]", pattern):
            return None
        steps = comb(len(text) + free, free) * len(pattern)
        if steps > _CHARACTERS_MAX or not self._may_use(steps // _STEPS_PER_CHARACTER):
            return None
        try:
            return re.search(pattern, text) is not None
        except re.error:
            return None

    def _truth(self, text: str, *, is_plain: bool) -> bool | None:
        if text.upper() in _TRUE:
            return True
        if text.upper() in _FALSE or text.upper().endswith("-NOTFOUND"):
            return False
        value = self._scope.get(text) if is_plain else None
        if value is None or not is_expanded(value):
            return None
        return value.upper() not in _FALSE and not value.upper().endswith("-NOTFOUND")


def _end_of(calls: Sequence[_WrittenCommand], index: int, name: str) -> int:
    """Return where a block ends whose inner commands begin at ``index``."""
    depth = 1
    for place in range(index, len(calls)):
        depth += (calls[place].name == name) - (calls[place].name == _ENDS[name])
        if depth == 0:
            return place
    return len(calls)


def _unescaped(text: str) -> str:
    return re.sub(r"\\([^A-Za-z0-9;])", r"\1", text) if "\\" in text else text


def _below(file: Path, folder: Path) -> str:
    try:
        return str(file.relative_to(folder))
    except ValueError:
        return str(file)
