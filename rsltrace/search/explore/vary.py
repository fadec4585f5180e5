"""The settings of each run of a job with ``vary:``, by its number."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import cached_property
from statistics import NormalDist
from typing import Any

from rsltrace.errors import ExploreError, JobError
from rsltrace.job import Job, locate
from rsltrace.job.parts.vary import SettingSpec, VarySpec
from rsltrace.search.explore.trial import JobSource, Trial
from rsltrace.simulation.chance.stream import RandomStream

_SAMPLES = 100
_DIGITS = 9
_TAIL = 1e-12


class Variations:
    """The combinations of values of ``spec``; ``seed`` decides what is drawn. ``count`` is how many
    there are, None if they have no end."""

    def __init__(self, spec: VarySpec, seed: int = 0) -> None:
        self._spec = spec
        self._seed = seed
        self.count = spec.samples
        if spec.method == "grid":
            self.count = math.prod(map(len, self._axes.values()))
        elif spec.method == "latin_hypercube":
            self.count = spec.samples or _SAMPLES

    def at(self, number: int) -> dict[str, Any] | None:
        """Return the values of combination ``number`` (from 0) by the keys of the job, plain JSON;
        None after the last.

        :raises ExploreError: SciPy is needed, and not there.
        """
        if self.count is not None and number >= self.count:
            return None
        if self._spec.method == "grid":
            return self._of_grid(number)
        found = {}
        for place, (name, setting) in enumerate(self._spec.settings.items()):
            if self._spec.method == "random":
                share = RandomStream(self._seed, f"vary\0{name}\0{number}").uniform()
            else:
                share = float(self._shares[number][place])
            found[name] = _value(setting, share)
        return found

    def _of_grid(self, number: int) -> dict[str, Any]:
        """Return one combination; the last setting changes first."""
        found = {}
        for name, values in reversed(list(self._axes.items())):
            number, place = divmod(number, len(values))
            found[name] = values[place]
        return {name: found[name] for name in self._axes}

    @cached_property
    def _axes(self) -> Mapping[str, list[Any]]:
        return {name: _axis(setting) for name, setting in self._spec.settings.items()}

    @cached_property
    def _shares(self) -> Any:
        """A share of its range for each setting of each run, from 0 to 1."""
        try:
            import numpy as np
            from scipy.stats import qmc
        except ImportError:
            raise ExploreError(
                "method: latin_hypercube needs SciPy: pip install 'rsltrace[explore]'"
            ) from None
        generator = np.random.default_rng(self._seed)
        sampler = qmc.LatinHypercube(len(self._spec.settings), seed=generator)
        return sampler.random(self.count)


def check_vary(source: JobSource, job: Job) -> None:
    """Raise JobError, with its line, at a setting that the job cannot have."""
    if job.vary is None:
        raise ExploreError(f"{source.path} has no vary:, which says what to vary and between what")
    for name, setting in job.vary.settings.items():
        where = locate(job, ("vary", "settings", name))
        for value in _extremes(setting):
            try:
                source.job(Trial(0, {"set": {name: value}}))
            except JobError as error:
                said = str(error)
                raise JobError(f"{name} cannot be {value}:\n{said}", where=where) from None


def _extremes(setting: SettingSpec) -> list[Any]:
    """Return the values that show whether a job can have all of them."""
    if setting.values is not None:
        return [_plain(value) for value in setting.values]
    return [_value(setting, 0.0), _value(setting, 1.0)]


def _axis(setting: SettingSpec) -> list[Any]:
    """Return the values that a grid has of a setting."""
    if setting.values is not None:
        return [_plain(value) for value in setting.values]
    if setting.integers is not None:
        first, last = setting.bounds
        return list(range(int(first), int(last) + 1))
    steps = setting.steps or 2
    return [_value(setting, step / (steps - 1)) for step in range(steps)]


def _value(setting: SettingSpec, share: float) -> Any:
    """Return the value at a share (0 to 1) of what a setting may be."""
    if setting.values is not None:
        place = min(int(share * len(setting.values)), len(setting.values) - 1)
        return _plain(setting.values[place])
    first, second = setting.bounds
    if setting.integers is not None:
        return min(int(first) + int(share * (second - first + 1)), int(second))
    if setting.uniform is not None:
        found = first + share * (second - first)
    elif setting.log_uniform is not None:
        found = first * math.exp(share * math.log(second / first))
    else:
        found = NormalDist(first, second).inv_cdf(min(max(share, _TAIL), 1 - _TAIL))
    if setting.of_time:
        return f"{max(round(found), 0)}ns"
    return float(f"{found:.{_DIGITS}g}")  # what a person may type, and exactly what is used


def _plain(value: Any) -> Any:
    """Return a value of a job file as JSON has it."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    for kind in (bool, int, float, str):
        if isinstance(value, kind):
            return kind(value)
    return value
