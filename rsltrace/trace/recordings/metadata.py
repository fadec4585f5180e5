"""Read ``metadata.yaml``: the files of a bag, their storage and compression."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

from rsltrace.errors import BagError
from rsltrace.trace.mcap.records import METADATA_YAML_BYTES_MAX
from rsltrace.trace.model.operation import nested_too_deep
from rsltrace.trace.model.texts import yaml_problem
from rsltrace.trace.recordings.topic import BagQos, parse_qos

NAME = "metadata.yaml"
_RECORDING = re.compile(r"\.(mcap|db3)(\.zstd)?$")
STORAGE_IDS = ("mcap", "sqlite3")


@dataclass(frozen=True, slots=True)
class BagMetadata:
    """What must be known before the storage files are opened.

    ``compression`` is ``""``, ``"file"`` or ``"message"`` (always zstd), None if unknown, like an
    empty ``storage_id``. ``topics`` has the QoS and type hash by (topic, type), for storage files
    without them. ``notes`` say what is missing.
    """

    storage_id: str
    files: tuple[Path, ...]
    compression: str | None
    topics: dict[tuple[str, str], tuple[tuple[BagQos, ...], str]]
    notes: tuple[str, ...] = ()


def read_metadata(folder: Path, *, recover: bool = False) -> BagMetadata:
    """Return the metadata of the bag in ``folder``. Raises ``BagError`` saying what to do.

    ``recover`` works without metadata.yaml, and without some of the listed files.
    """
    path = folder / NAME
    if not path.is_file():
        recordings = sorted(
            p.name for p in folder.iterdir() if ".mcap" in p.name or ".db3" in p.name
        )
        if not recordings:
            raise BagError(f"{folder}: not a bag: there is no {NAME} and no recording in it")
        if recover:
            return _without_metadata(folder)
        raise BagError(
            f"{folder}: there is no {NAME}; make one with 'ros2 bag reindex {folder}', or "
            f"name a file in it ({', '.join(recordings)})"
        )
    values = _load(path)
    try:
        information = values["rosbag2_bagfile_information"]
        storage_id = information["storage_identifier"]
        names = list(information["relative_file_paths"])
        mode = str(information.get("compression_mode") or "").lower()
        scheme = str(information.get("compression_format") or "")
        topics = dict(map(_topic, information["topics_with_message_count"]))
    except KeyError as error:
        raise BagError(f"{path}: the key {error} is missing; run 'ros2 bag reindex'") from None
    except (TypeError, AttributeError, ValueError):
        raise BagError(f"{path}: not the metadata of a bag; run 'ros2 bag reindex'") from None
    if storage_id not in STORAGE_IDS:
        raise BagError(
            f"{path}: the storage {storage_id!r} is unknown (only {' and '.join(STORAGE_IDS)}); "
            "convert the bag with 'ros2 bag convert'"
        )
    compression = "" if mode in ("", "none") else mode
    if compression not in ("", "file", "message") or (compression and scheme != "zstd"):
        raise BagError(
            f"{path}: the compression {scheme!r} by {mode!r} is unknown (only zstd, by file or "
            "message); convert the bag with 'ros2 bag convert'"
        )
    # Before version 4 the folder's name came first. Only file names are used, so a bag cannot point
    # outside its folder.
    files = tuple(folder / PurePosixPath(str(name)).name for name in names)
    if not files:
        raise BagError(f"{path}: no storage files are listed: the bag is empty")
    missing = [file.name for file in files if not file.is_file()]
    notes: tuple[str, ...] = ()
    if missing and recover and len(missing) < len(files):
        notes = (f"{path}: {', '.join(missing)} is listed but not there: left out",)
        files = tuple(file for file in files if file.is_file())
    elif missing:
        raise BagError(
            f"{path}: {', '.join(missing)} is listed but not there; put it back, or run "
            "'ros2 bag reindex' to do without"
        )
    return BagMetadata(storage_id, files, compression, topics, notes)


def _without_metadata(folder: Path) -> BagMetadata:
    """Return what the storage files of a folder without metadata.yaml show."""
    names = [path.name for path in folder.iterdir() if _RECORDING.search(path.name)]
    # A file and its compressed form are one.
    names = [name for name in names if name.removesuffix(".zstd") == name or name[:-5] not in names]
    names.sort(key=lambda name: [int(p) if p.isdigit() else p for p in re.split(r"(\d+)", name)])
    if not names:
        raise BagError(f"{folder}: not a bag: there is no {NAME} and no recording in it")
    note = f"{folder}: there is no {NAME}; played without it: {', '.join(names)}"
    return BagMetadata("", tuple(folder / name for name in names), None, {}, (note,))


def _topic(item: Any) -> tuple[tuple[str, str], tuple[tuple[BagQos, ...], str]]:
    values = item["topic_metadata"]
    offered = parse_qos(values.get("offered_qos_profiles", ""))
    return (values["name"], values["type"]), (offered, values.get("type_description_hash") or "")


def _load(path: Path) -> Any:
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    try:
        if path.stat().st_size > METADATA_YAML_BYTES_MAX:
            most = METADATA_YAML_BYTES_MAX >> 20
            raise BagError(f"{path}: larger than any bag's ({most} MiB); run 'ros2 bag reindex'")
        text = path.read_text(encoding="utf-8")
        if nested_too_deep(text) >= 0:
            raise BagError(f"{path}: brackets are nested too deeply; run 'ros2 bag reindex'")
        return YAML(typ="safe", pure=True).load(text)
    except (YAMLError, UnicodeDecodeError, RecursionError) as error:
        raise BagError(
            f"{path}: not YAML ({yaml_problem(error)}); run 'ros2 bag reindex'"
        ) from None
    except OSError as error:
        raise BagError(f"{path}: {error.strerror}") from None
