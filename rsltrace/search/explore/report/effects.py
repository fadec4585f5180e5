"""Which setting matters: how much of a metric, or of failing, goes with each setting.

A setting with many values is ranked against the outcome (Spearman); one with few is a factor
(Kruskal and Wallis). Neither takes for granted that anything is linear or normal. With many pairs
some look related by chance: the p-values are Holm's, of all pairs together.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from rsltrace.errors import ExploreError
from rsltrace.search.explore.report.exploration import Value, settings
from rsltrace.search.explore.trial import TrialResult

FAILS = "fails"
"""The outcome that a run fails (1) or does not (0)."""

_FEW = 6
"""So many values of a setting, or fewer, are a factor."""
_RUNS_MIN = 5
_SURE = 0.05


@dataclass(frozen=True, slots=True)
class Effect:
    """What a setting has to do with an outcome (a metric, or ``fails``).

    ``strength`` is the share of the ranks' variance that goes with it, 0 to 1; ``sign`` says
    whether more of a number is more (1) or less (-1), 0 for texts. ``p`` is how likely a
    strength like this is by chance, corrected for the number of pairs; ``runs`` how many were
    compared.
    """

    setting: str
    outcome: str
    strength: float
    sign: int
    p: float
    runs: int

    @property
    def is_sure(self) -> bool:
        """Whether chance is no likely explanation."""
        return self.p < _SURE


def effects(results: Sequence[TrialResult]) -> list[Effect]:
    """Return the effects of all settings, the surest first.

    :raises ExploreError: scipy is not installed.
    """
    varied = [settings(one.trial) for one in results]
    names = list(dict.fromkeys(name for one in varied for name in one))
    outcomes = list(dict.fromkeys(name for one in results for name in one.metrics))
    found = []
    for name in names:
        for outcome in [FAILS, *outcomes]:
            pairs = _pairs(name, outcome, varied, results)
            effect = _effect(name, outcome, pairs)
            if effect is not None:
                found.append(effect)
    found.sort(key=lambda one: (one.p, -one.strength))
    return _corrected(found)


def _pairs(
    name: str,
    outcome: str,
    varied: Sequence[Mapping[str, Value]],
    results: Sequence[TrialResult],
) -> list[tuple[Value, float]]:
    pairs = []
    for given, result in zip(varied, results, strict=True):
        if name not in given:
            continue
        if outcome == FAILS:
            pairs.append((given[name], float(result.failure is not None)))
        elif outcome in result.metrics:
            pairs.append((given[name], float(result.metrics[outcome])))
    return [pair for pair in pairs if pair[1] == pair[1]]  # NaN says nothing


def _effect(name: str, outcome: str, pairs: Sequence[tuple[Value, float]]) -> Effect | None:
    values = {value for value, _ in pairs}
    if len(pairs) < _RUNS_MIN or len(values) < 2 or len({y for _, y in pairs}) < 2:
        return None
    try:
        from scipy import stats
    except ImportError:
        raise ExploreError(
            "the table of effects needs scipy: pip install 'rsltrace[explore]'"
        ) from None
    sign = 0
    if all(isinstance(value, float) for value in values):
        ranked = stats.spearmanr([x for x, _ in pairs], [y for _, y in pairs])
        related = float(ranked.statistic)
        sign = (related > 0) - (related < 0)
        if len(values) > _FEW:
            return Effect(name, outcome, related**2, sign, float(ranked.pvalue), len(pairs))
    groups = [[y for x, y in pairs if x == value] for value in sorted(values, key=str)]
    tested = stats.kruskal(*groups)
    strength = min(float(tested.statistic) / (len(pairs) - 1), 1.0)
    return Effect(name, outcome, strength, sign, float(tested.pvalue), len(pairs))


def _corrected(found: Sequence[Effect]) -> list[Effect]:
    """Return effects, in order of p, with Holm's correction."""
    corrected, least = [], 0.0
    for index, effect in enumerate(found):
        least = max(least, min(1.0, effect.p * (len(found) - index)))
        corrected.append(replace(effect, p=least))
    return corrected
