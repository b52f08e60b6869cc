"""The grammar of signal paths: from what a person copies out of a viewer to one number in a message."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

from flexid_cli.errors import InputError

Step = str | int
_SHOWN = 8
_NEGATIVE = re.compile(r"\[-(\d+)\]")


@dataclass(frozen=True)
class Leaf:
    """Where one number stands in the messages of a topic.

    Attributes
    ----------
    topic : str
        Topic of the messages.
    steps : tuple of str or int
        Fields and array places from the message down to the number; negative places count from the end.
    joint : str
        Name of the array element, where a parallel array of names exists; the last of ``steps`` is then its
        place in the message that was looked at, which may change from message to message.
    names : tuple of str or int, or None
        Where the parallel array of names stands.
    """

    topic: str
    steps: tuple[Step, ...]
    joint: str = ""
    names: tuple[Step, ...] | None = None


def dotted(steps: Sequence[Step], separator: str = ".") -> str:
    """Spell ``steps`` as ``.field.sub[2]``, each field after ``separator``."""
    return "".join(f"[{step}]" if isinstance(step, int) else f"{separator}{step}" for step in steps)


def canonical(leaf: Leaf) -> str:
    """Return the one spelling that reports use: ``/topic/joint/field`` or ``/topic.field.sub[2]``."""
    if leaf.joint:
        return f"{leaf.topic}/{leaf.joint}/{dotted(leaf.steps[:-1])[1:]}"
    return leaf.topic + dotted(leaf.steps)


def spellings(leaf: Leaf) -> tuple[str, ...]:
    """Return the other usual spellings of a channel, without the canonical one."""
    forms = [leaf.topic + dotted(leaf.steps), leaf.topic + dotted(leaf.steps, "/")]
    own = canonical(leaf)
    return tuple(dict.fromkeys(form for form in forms if form != own))


def may_name(source: str, topic: str) -> bool:
    """Whether ``source`` can be a path into ``topic`` (a missing leading slash is forgiven)."""
    path, head = _key(source), _key(topic)
    return path == head or path.startswith((f"{head}/", f"{head}["))


def topic_of(source: str, topics: Iterable[str]) -> str | None:
    """Return the longest topic that ``source`` can be a path into, or None."""
    fitting = [topic for topic in topics if may_name(source, topic)]
    return max(fitting, key=len) if fitting else None


def resolve(source: str, leaves: Sequence[Leaf], topics: Iterable[str] = (), *, log: str = "the log") -> Leaf:
    """Find the number that ``source`` names.

    Accepted are ``/topic/joint/field``, ``/topic/field[2]``, ``/topic.field[2]``, ``[-1]`` for the last
    element, nested fields, and a path that stops above a single number (``/current`` for ``/current.data``).

    Parameters
    ----------
    source : str
        The path as a person wrote it.
    leaves : sequence of Leaf
        All numbers of the log.
    topics : iterable of str
        Topics of the log, for the message where nothing fits.
    log : str
        Name of the log, for the message.

    Raises
    ------
    InputError
        Nothing fits (the nearest channels are named), or more than one channel does (all are named).
    """
    own = {canonical(leaf): leaf for leaf in leaves}
    if source in own:
        return own[source]
    table = _table(leaves)
    path = _key(source)
    for candidates in (table.get(path, {}), _from_the_end(path, table), _below(path, table)):
        if len(candidates) == 1:
            return next(iter(candidates.values()))
        if candidates:
            raise _ambiguous(source, candidates)
    raise _missing(source, list(own), leaves, topics, log)


def nearest(source: str, known: Iterable[str], count: int = 3) -> list[str]:
    """Return the names of ``known`` that look most like ``source``, best first."""
    folded: dict[str, str] = {}
    for name in known:
        folded.setdefault(name.lower(), name)
    return [folded[hit] for hit in difflib.get_close_matches(source.lower(), folded, n=count, cutoff=0.5)]


def missing_channel(source: str, known: Sequence[str], *, log: str, detail: str = "") -> InputError:
    """Return the error for a channel that the log does not have, with the nearest names."""
    near = nearest(source, known)
    hint = f"did you mean {' or '.join(map(repr, near))}? " if near else ""
    if not near and known:
        hint = f"it has {_listing(known)}. "
    return InputError(
        f"{log}: there is no channel {source!r}{detail}",
        f"{hint}`flexid inspect {log}` lists all channels",
    )


def _key(path: str) -> str:
    return re.sub(r"[./]+", "/", path.strip()).strip("/")


def _table(leaves: Iterable[Leaf]) -> dict[str, dict[str, Leaf]]:
    """Index leaves by the keys of their spellings; each key holds its leaves by canonical path."""
    table: dict[str, dict[str, Leaf]] = {}
    for leaf in leaves:
        table.setdefault(_key(canonical(leaf)), {}).setdefault(canonical(leaf), leaf)
        if leaf.joint:
            by_place = replace(leaf, joint="")
            table.setdefault(_key(canonical(by_place)), {}).setdefault(canonical(by_place), by_place)
    return table


def _from_the_end(path: str, table: Mapping[str, Mapping[str, Leaf]]) -> dict[str, Leaf]:
    """Leaves that ``path`` names by one place counted from the end of an array."""
    found = _NEGATIVE.findall(path)
    if len(found) != 1:
        return {}
    back = int(found[0])
    before, after = (re.escape(part) for part in re.split(r"\[-\d+\]", path))
    pattern = re.compile(rf"{before}\[(\d+)\]{after}")
    places = {int(hit[1]): key for key in table if (hit := pattern.fullmatch(key))}
    key = places.get(max(places, default=0) + 1 - back) if back else None
    if key is None:
        return {}
    counted = {}
    for leaf in table[key].values():
        if not leaf.joint:
            place = max(i for i, step in enumerate(leaf.steps) if isinstance(step, int))
            steps = (*leaf.steps[:place], -back, *leaf.steps[place + 1 :])
            other = replace(leaf, steps=steps)
            counted[canonical(other)] = other
    return counted


def _below(path: str, table: Mapping[str, Mapping[str, Leaf]]) -> dict[str, Leaf]:
    """Leaves below ``path``, each number once: by its joint's name where it has one."""
    named = {
        (leaf.topic, leaf.steps): leaf for leaves in table.values() for leaf in leaves.values() if leaf.joint
    }
    below = [
        named.get((leaf.topic, leaf.steps), leaf)
        for key, leaves in table.items()
        if key.startswith((f"{path}/", f"{path}["))
        for leaf in leaves.values()
    ]
    return {canonical(leaf): leaf for leaf in below}


def _ambiguous(source: str, candidates: Mapping[str, Leaf]) -> InputError:
    return InputError(
        f"channel {source!r} is ambiguous: it can be {_listing(sorted(candidates))}",
        "write one of them in full",
    )


def _listing(names: Sequence[str]) -> str:
    shown = ", ".join(names[:_SHOWN])
    return shown + (f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else "")


def _missing(
    source: str, known: Sequence[str], leaves: Sequence[Leaf], topics: Iterable[str], log: str
) -> InputError:
    topic = topic_of(source, topics)
    if topic is None:
        everything = [*known, *(form for leaf in leaves for form in spellings(leaf))]
        return missing_channel(source, everything, log=log)
    inside = [leaf for leaf in leaves if leaf.topic == topic]
    if not inside:
        return InputError(
            f"{log}: topic {topic!r} holds no numbers, so there is no channel {source!r}",
            f"`flexid inspect {log}` lists all channels",
        )
    mine = [canonical(leaf) for leaf in inside] + [form for leaf in inside for form in spellings(leaf)]
    return missing_channel(source, mine, log=log, detail=f" in topic {topic!r}")
