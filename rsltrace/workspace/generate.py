"""Runs rosidl over the interface files of one package; in a process of its own.

rosidl's templates take over standard output, and its parsers leave much behind: a run whose
classes are made just now shall not differ from one that finds them. What is to be done comes as
JSON on standard input, what went wrong is the last line of standard error.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

_SERVICE = ("", "_Event", "_Request", "_Response")
_ACTION = ("", *(f"_{part}{end}" for part in ("GetResult", "SendGoal") for end in _SERVICE[1:]))
_EXPORTS = {"msg": ("",), "srv": _SERVICE, "action": _ACTION}
"""What the package of a kind offers of each interface, as rosidl has it."""

_NOT_COMPILED = '''\
"""Stands in for the compiled type support, which nothing in a simulation calls."""


class _NotCompiled:
    def __init__(self, name):
        self.name = name

    def __call__(self, *arguments):
        raise RuntimeError(f"{self.name}: the interfaces of this package have not been built")


def __getattr__(name):
    if name.startswith("_"):
        raise AttributeError(name)
    return _NotCompiled(name)
'''


def main() -> str | None:
    """Make the prefix that the order on standard input asks for; return what went wrong."""
    order = json.load(sys.stdin)
    package, into = order["package"], Path(order["into"])
    share, site = into / "share" / package, into / "site-packages" / package
    idl_files = []
    for folder, file in order["files"]:
        try:
            idl_files.append(_convert(Path(folder), package, Path(file), share))
        except Exception as error:
            return _failed(Path(folder, file), error)
    arguments = {
        "package_name": package,
        "output_dir": str(site),
        "template_dir": order["templates"],
        "target_dependencies": [],
        "idl_tuples": [f"{share}:{idl.relative_to(share)}" for idl in idl_files],
        "include_paths": [f"{name}:{place}" for name, place in order["shares"].items()],
    }
    try:
        _write_classes(arguments, into / "arguments.json")
        _write_packages(site, package, [Path(file) for _, file in order["files"]])
        _describe_types(arguments, share, into / "arguments.json")
    except Exception as error:
        return _failed(Path(order["files"][0][0]), error)
    return None


def _failed(place: Path, error: Exception) -> str:
    said = " ".join(str(error).split()) or type(error).__name__
    return f"\n{json.dumps({'place': str(place), 'error': said})}"


def _convert(folder: Path, package: str, file: Path, share: Path) -> Path:
    from rosidl_adapter import convert_to_idl

    (share / file.parent).mkdir(parents=True, exist_ok=True)
    (share / file).write_bytes((folder / file).read_bytes())
    made: Path = convert_to_idl(folder, package, file, share)
    return made


def _write_classes(arguments: Mapping[str, Any], place: Path) -> None:
    from rosidl_pycommon import generate_files

    place.write_text(json.dumps(arguments))
    generate_files(str(place), {"_idl.py.em": "_%s.py"})


def _write_packages(site: Path, package: str, files: list[Path]) -> None:
    """Write the modules that rosidl's generator would, but for those that need a compiler."""
    (site / "__init__.py").touch()
    (site / f"{package}_s__rosidl_typesupport_c.py").write_text(_NOT_COMPILED)
    for kind in sorted({file.suffix[1:] for file in files}):
        lines = _exports(package, kind, sorted(f.stem for f in files if f.suffix == f".{kind}"))
        (site / kind / "__init__.py").write_text("".join(lines))


def _exports(package: str, kind: str, names: list[str]) -> Iterator[str]:
    from rosidl_pycommon import convert_camel_case_to_lower_case_underscore

    for name in names:
        module = f"{package}.{kind}._{convert_camel_case_to_lower_case_underscore(name)}"
        for part in _EXPORTS[kind]:
            yield f"from {module} import {name}{part}  # noqa: F401\n"


def _describe_types(arguments: Mapping[str, Any], share: Path, place: Path) -> None:
    """Write the descriptions with the hashes of the types, if those of others are there, too."""
    from rosidl_generator_type_description import generate_type_hash

    place.write_text(json.dumps({**arguments, "output_dir": str(share)}))
    try:
        generate_type_hash(str(place))
    except (KeyError, OSError):
        pass  # of a package that was built without: types work without hashes
    place.unlink()


if __name__ == "__main__":
    sys.exit(main())
