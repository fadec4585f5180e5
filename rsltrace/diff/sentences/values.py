"""Values inside of sentences: what a field, a setting, a state was in one run and in the other."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from rsltrace.diff.facts.bags import MessageDivergence
from rsltrace.diff.facts.evidence import (
    CauseLink,
    CauseLinkKind,
    FieldDifference,
    FieldNote,
    FieldNoteKind,
    MessageDifference,
    NoFieldsReason,
    OutputOrder,
    ParameterChanges,
    ParameterValues,
    Presence,
    SendCount,
    SendDelay,
    Setting,
    SettingKind,
    StateDifference,
    TimerCancellation,
    TimerPeriod,
)
from rsltrace.diff.sentences import SENTENCES, says, sentence
from rsltrace.trace.model.event import OutputKind
from rsltrace.trace.model.texts import (
    contrasting_durations,
    contrasting_texts,
    counted,
    format_duration,
    printable,
    shortened,
)

NAMED_MAX = 3
_VALUE_MAX = 40
_SETTING_MAX = 60

IN_ONE = {Presence.ONLY_A: "only in a", Presence.ONLY_B: "only in b"}
_LABELS = {OutputKind.REQUEST: "call ", OutputKind.RESPONSE: "reply "}
_NOTES = {
    FieldNoteKind.OTHER_TYPES: "different types",
    FieldNoteKind.NO_SUCH_FIELD: "only one of the types has this field",
    FieldNoteKind.LENGTHS: "length {a} and {b}",
    FieldNoteKind.SAME_ELEMENTS: "the same elements in a different order",
    FieldNoteKind.SAME_WORDS: "the same words in a different order",
    FieldNoteKind.FIRST_BYTE: "first at byte {a}",
    FieldNoteKind.FIRST_CHARACTER: "first at character {a}",
    FieldNoteKind.CONSTANTS: "{a} → {b}",
    FieldNoteKind.NAN_PAYLOAD: "NaN with a different payload",
    FieldNoteKind.NAN_IN_A: "NaN in a only",
    FieldNoteKind.NAN_IN_B: "NaN in b only",
    FieldNoteKind.INFINITE_IN_A: "infinite in a only",
    FieldNoteKind.INFINITE_IN_B: "infinite in b only",
    FieldNoteKind.OPPOSITE_INFINITIES: "infinities of opposite sign",
    FieldNoteKind.SIGN_OF_ZERO: "sign of zero",
}
_LINKS = {
    CauseLinkKind.PUBLISHED: "published",
    CauseLinkKind.CALLED: "called",
    CauseLinkKind.ANSWERED: "answered",
    CauseLinkKind.LOGGED: "logged to",
    CauseLinkKind.TRIGGERED: "triggered",
    CauseLinkKind.MADE_TASK: "created or resumed a task of",
    CauseLinkKind.CAUSED: "caused",
    CauseLinkKind.CHANGED_STATE: "may have changed the state of",
    CauseLinkKind.DRAWN_AGAIN: "draws a different value in",
    CauseLinkKind.MADE_RECEIVER: "created a receiver of",
    CauseLinkKind.KEEPS_WAITING: "keeps waiting",
    CauseLinkKind.ENDED_BEFORE: "ended before",
}


# -- two values that differ ------------------------------------------------------------------------


def durations(a_ns: int, b_ns: int) -> str:
    """Return two durations, with one unit where that is the same: ``20 → 26 ms``."""
    a, b = contrasting_durations(a_ns, b_ns)
    (number, unit), (_, other_unit) = a.split(), b.split()
    return f"{number} → {b}" if unit == other_unit else f"{a} → {b}"


def pair_text(a: str | None, b: str | None) -> str:
    """Return ``old → new``, in which one sees what differs."""
    one, other = contrasting_texts("nothing" if a is None else a, "nothing" if b is None else b)
    return f"{one} → {other}"


def listed(things: Sequence[str]) -> str:
    """Return the first texts with commas, each once, and how many more there are."""
    unique = list(dict.fromkeys(things))
    more = len(unique) - NAMED_MAX
    return ", ".join(unique[:NAMED_MAX]) + (f" and {more} more" if more > 0 else "")


def joined(things: Sequence[str]) -> str:
    """Return texts with commas and an ``and`` before the last."""
    unique = list(dict.fromkeys(things))
    if len(unique) > NAMED_MAX:
        return listed(unique)
    return " and ".join(filter(None, (", ".join(unique[:-1]), unique[-1])))


# -- fields and states -----------------------------------------------------------------------------


def field_text(fields: Sequence[FieldDifference], more_fields: int) -> str:
    """Return what differs in a message: ``data 0.28026 → 0.28027``, and how many more fields."""
    if not fields:
        return ""
    first = fields[0]
    if same := first.note_of(FieldNoteKind.SAME_ELEMENTS):
        text = f"{first.path} has {note_text(same)}"
    elif first.elements is not None and first.elements[0] > 1:
        text = f"{first.elements[0]} of {first.elements[1]} elements of {first.path}"
    else:
        text = f"{first.path} {pair_text(first.a, first.b)}"
        named = first.note_of(FieldNoteKind.CONSTANTS, FieldNoteKind.SAME_WORDS)
        text += f" ({note_text(named)})" if named else ""
    more = len(fields) - 1 + more_fields
    return f"{text} and {counted(more, 'more field')}" if more else text


def note_text(note: FieldNote) -> str:
    text = _NOTES[note.kind].format(a=note.a, b=note.b)
    return f"{text}: {note.count}" if note.count else text


def notes_text(found: FieldDifference) -> str:
    """Return all that is special about two values."""
    return "; ".join(map(note_text, found.notes))


def state_text(state: Sequence[StateDifference]) -> str:
    """Return `` (count 3 → 4)``, "" if nothing is known of it."""
    if not state:
        return ""
    more = f" and {len(state) - 1} more" if len(state) > 1 else ""
    return f" ({state[0].path} {pair_text(state[0].a, state[0].b)}{more})"


# -- settings --------------------------------------------------------------------------------------


def setting_name(setting: Setting) -> str:
    """Return ``job.yaml:12: delay``, ``environment: numpy``."""
    return f"{setting.place}: {setting.key}" if setting.key else setting.place


def because_of(settings: Sequence[Setting]) -> str:
    """Say that the runs had different settings, and which; "" if they had not."""
    if not settings:
        return ""
    return f"the runs had different settings: {listed([_setting_text(one) for one in settings])}"


def _setting_text(setting: Setting) -> str:
    name = setting_name(setting)
    values = [value for value in (setting.a, setting.b) if value is not None]
    if setting.kind is SettingKind.ENVIRONMENT and setting.a is not None and setting.b is not None:
        shown = contrasting_texts(setting.a, setting.b, _SETTING_MAX)
        return f"environment.{printable(setting.name)} ({', '.join(shown)})"
    if not setting.key:
        return name
    is_long = any(len(value) > _SETTING_MAX or "\n" in value for value in values)
    if len(values) == 2:
        return name if is_long else f"{name} {' → '.join(values)}"
    only = f"only in {'b' if setting.a is None else 'a'}"
    return f"{name} ({only if is_long else f'{values[0]} {only}'})" if values else ""


# -- messages and other outputs --------------------------------------------------------------------


def a_first(messages: Sequence[MessageDifference]) -> list[MessageDifference]:
    """Return messages with what is only in a in front, among as many as a sentence names."""
    named = sorted(messages[:NAMED_MAX], key=lambda m: m.presence is Presence.ONLY_B)
    return [*named, *messages[NAMED_MAX:]]


def what_differs(messages: Sequence[MessageDifference]) -> str:
    """Return `` (/odom: pose.x 1.0 → 1.5, call /plan only in b)``, "" if no output differs."""
    outputs = [m for m in messages if not m.is_input]
    moved = [_label(m) for m in outputs if isinstance(m.fate, OutputOrder)]
    things = [
        _thing(m) for m in a_first([m for m in outputs if not isinstance(m.fate, OutputOrder)])
    ]
    times = Counter(things)
    things = [f"{thing}, {n} times" if n > 1 else thing for thing, n in times.items()]
    if moved:
        things.insert(0, f"{joined(moved)} {sentence(OutputOrder())}")
    return f" ({listed(things)})" if things else ""


def _thing(message: MessageDifference) -> str:
    label, fate = _label(message), message.fate
    if message.presence is Presence.BOTH:
        if isinstance(fate, ParameterChanges):
            return f"parameter {sentence(fate)}"
        if fate is not None:
            return f"{label}: {sentence(fate)}"
        fields = field_text(message.fields, message.more_fields)
        return f"{label}: {fields}" if fields else label
    if message.kind is OutputKind.LOG and message.preview:
        label = f"log {message.preview}"
    if fate is not None and not isinstance(fate, ParameterValues):
        return f"{label} {sentence(fate)}"
    if fate is not None:
        label = f"{label}: {sentence(fate)}"
    return f"{label} {IN_ONE[message.presence]}"


def _label(message: MessageDifference) -> str:
    return f"{_LABELS.get(message.kind, '') if message.kind else ''}{message.topic}"


@says(SendCount)
def _(fate: SendCount, of: object) -> str:
    times = {(1, 2): "twice in b", (2, 1): "twice in a"}
    return times.get((fate.a, fate.b), f"{fate.a} times in a, {fate.b} times in b")


@says(TimerPeriod)
def _(fate: TimerPeriod, of: object) -> str:
    if fate.before_ns is None:
        return f"set to a period of {format_duration(fate.after_ns)} in {fate.run}"
    where = f" in {fate.run}" if fate.run else ""
    return f"period {durations(fate.before_ns, fate.after_ns)}{where}"


def output_change_text(message: MessageDifference) -> str:
    """Return what became of an output, "" if there is nothing to say."""
    return "" if message.fate is None else sentence(message.fate)


def no_fields_text(message: MessageDifference | MessageDivergence) -> str:
    """Say why no field of a message is shown, and how to see it; "" where there are some."""
    if isinstance(message, MessageDifference) and isinstance(message.fate, OutputOrder):
        return "sent in a different order"
    return "" if message.no_fields is None else sentence(message.no_fields, message)


@says(*NoFieldsReason)
def _(why: NoFieldsReason, of: MessageDifference | MessageDivergence) -> str:
    if why is NoFieldsReason.ALL_IGNORED:
        return "all fields that differ are ignored"
    if why is NoFieldsReason.EQUAL_FIELDS:
        return "its fields are equal, but the recorded hashes differ"
    if why is NoFieldsReason.UNREADABLE:
        return of.error
    if why is NoFieldsReason.UNDESCRIBED_BYTES:
        return "the messages differ in bytes that their types do not describe"
    where = "a" if why is NoFieldsReason.NOT_RECORDED_IN_A else "b"
    return (
        f"only its hash was recorded in {where}; to see its fields, record with payloads: true "
        f"and a topic glob that matches {of.topic} (record: in the job)"
    )


def link_text(link: CauseLink) -> str:
    """Return how an event led to the next one: ``published /odom``."""
    if link.kind is CauseLinkKind.MORE_STEPS:
        return f"led, in {link.steps} more steps, to"
    return f"{_LINKS.get(link.kind, '')} {link.name}".strip()


SENTENCES.update(
    {
        OutputOrder: lambda fact, of: "in a different order",
        SendDelay: lambda fact, of: f"{format_duration(fact.by_ns)} later in {fact.run}",
        TimerCancellation: lambda fact, of: f"cancelled in {fact.run}",
        ParameterValues: lambda fact, of: ", ".join(
            f"{name} = {shortened(value, _VALUE_MAX)}" for name, value in fact.values
        ),
        ParameterChanges: lambda fact, of: ", ".join(
            f"{name} {pair_text(a, b)}" for name, a, b in fact.values
        ),
    }
)
