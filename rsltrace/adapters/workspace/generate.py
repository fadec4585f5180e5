"""Runs rosidl over interface files, one after the other; in a process of its own.

rosidl's templates take over standard output, and its parsers leave much behind: a run whose
classes are made just now shall not differ from one that finds them. What is to be done comes as
JSON on standard input, what went wrong is the last line of standard error. What an interface needs
is made in a folder beside, and goes to its place file by file when it is whole, the module with the
class last: a run that is cut off loses only the one it was at.
"""

from __future__ import annotations

import json
import os
import shutil
import sys
import tempfile
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

READY = "\x01ready\n"
"""A line of standard output for each interface that is ready; rosidl's own are others."""
_TYPES = (
    "bool, byte, char, float32, float64, int8 to int64, uint8 to uint64, string, wstring and "
    "messages (package/Name)"
)
_NEW = ".new-"
"""What is begun long ago and was never ready is removed by its name: ``cache``."""


def main() -> str | None:
    """Make the interfaces that the order on standard input asks for; return what went wrong."""
    _parse_less()
    order = json.load(sys.stdin)
    for one in order["interfaces"]:
        into = Path(one["into"])
        made = Path(tempfile.mkdtemp(dir=into.parent, prefix=_NEW))
        try:
            _make(one, order, made)
            _put(made, into)
            os.write(1, READY.encode())
        except Exception as error:
            path = Path(one["path"])
            line = _faulty_line(one["package"], path)
            place = f"{path}:{line}" if line else str(path)
            return f"\n{json.dumps({'place': place, 'error': _text_of(error)})}"
        finally:
            shutil.rmtree(made, ignore_errors=True)
    return None


def _parse_less() -> None:
    """Parse each file once, which both generators do, and without its comments, which neither uses:
    that takes most of the time."""
    from rosidl_adapter import parser as adapter_parser
    from rosidl_parser import parser

    adapter_parser.process_comments = lambda element: element.annotations.pop("comment", None)
    parser.get_ast_from_idl_string = lru_cache(1)(parser.get_ast_from_idl_string)


def _make(one: Mapping[str, str], order: Mapping[str, Any], into: Path) -> None:
    from rosidl_adapter import convert_to_idl
    from rosidl_pycommon import generate_files

    package, file = one["package"], Path(one["file"])
    share, site = into / "share" / package, into / "site-packages" / package
    (share / file.parent).mkdir(parents=True)
    (share / file).write_bytes(Path(one["path"]).read_bytes())
    idl = convert_to_idl(share, package, file, share)
    arguments = {
        "package_name": package,
        "output_dir": str(site),
        "template_dir": order["templates"],
        "target_dependencies": [],
        "idl_tuples": [f"{share}:{idl.relative_to(share)}"],
        "include_paths": [f"{name}:{place}" for name, place in order["shares"].items()],
    }
    place = into / "arguments.json"
    place.write_text(json.dumps(arguments))
    generate_files(str(place), {"_idl.py.em": "_%s.py"})
    _describe_types(arguments, share, place)


def _describe_types(arguments: Mapping[str, Any], share: Path, place: Path) -> None:
    """Write the descriptions with the hashes of the types, if those of others are there, too."""
    from rosidl_generator_type_description import generate_type_hash

    place.write_text(json.dumps({**arguments, "output_dir": str(share)}))
    try:
        generate_type_hash(str(place))
    except (KeyError, OSError):
        pass  # of a package that was built without: types work without hashes


def _text_of(error: Exception) -> str:
    """Return what rosidl says, and what to write where that is not in it."""
    text, kind = " ".join(str(error).split()), type(error).__name__
    if kind == "InvalidFieldDefinition":
        return f"{text!r} has no name: write a type and a name"
    if kind == "InvalidResourceName" and "/" in text:
        return f"{text!r} is not a type: write package/Name"
    if "is an invalid message name" in text:
        return f"{text.partition(' is an ')[0]} is not a type of ROS 2: those are {_TYPES}"
    return text or kind


def _faulty_line(package: str, path: Path) -> int:
    """Return the number of the first line that rosidl cannot read by itself; 0 if there is none."""
    from rosidl_adapter.parser import parse_message_string

    for number, line in enumerate(path.read_text("utf-8", "replace").splitlines(), 1):
        try:
            if line.rstrip() != "---":
                parse_message_string(package, "Name", line)
        except Exception:
            return number
    return 0


def _put(made: Path, into: Path) -> None:
    for top in ("share", "site-packages"):
        for path in sorted((made / top).rglob("*")):
            if path.is_file():
                place = into / path.relative_to(made)
                place.parent.mkdir(parents=True, exist_ok=True)
                os.replace(path, place)


if __name__ == "__main__":
    sys.exit(main())
