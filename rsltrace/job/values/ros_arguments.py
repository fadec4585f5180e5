"""Telling a program's own words from the ROS arguments on one command line."""

from __future__ import annotations

from collections.abc import Sequence


def split_ros_arguments(words: Sequence[str]) -> tuple[list[str], list[str]]:
    """Return a program's own words, and those between each ``--ros-args`` and ``--`` (or the end).

    A ``--`` that ends no ROS arguments stays.
    """
    own: list[str] = []
    ros: list[str] = []
    inside = False
    for word in words:
        if word == "--ros-args":
            inside = True
        elif word == "--" and inside:
            inside = False
        else:
            (ros if inside else own).append(word)
    return own, ros
