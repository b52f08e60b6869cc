"""The grammar of signal paths."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from flexid_cli.errors import InputError
from flexid_cli.readers.path import Leaf, canonical, may_name, nearest, resolve, spellings, topic_of


def joint_states(
    topic: str = "/joint_states", joints: tuple[str, ...] = ("joint_1", "joint_2", "joint_3")
) -> list[Leaf]:
    return [
        Leaf(topic, (field, place), joint, ("name",))
        for field in ("position", "effort")
        for place, joint in enumerate(joints)
    ]


LEAVES = [
    *joint_states(),
    Leaf("/imu", ("angular_velocity", "z")),
    Leaf("/imu", ("covariance", 0)),
    Leaf("/imu", ("covariance", 1)),
    Leaf("/current", ("data",)),
    Leaf("/arm/drive", ("axes", 0, "position", "raw")),
    Leaf("/arm/drive", ("axes", 1, "position", "raw")),
    Leaf("/arm", ("temperature",)),
]
TOPICS = sorted({leaf.topic for leaf in LEAVES})


@pytest.mark.parametrize(
    ("source", "expected"),
    [
        ("/joint_states/joint_3/position", "/joint_states/joint_3/position"),
        ("joint_states/joint_3/position", "/joint_states/joint_3/position"),
        ("/joint_states.joint_3.position", "/joint_states/joint_3/position"),
        ("/joint_states/position[2]", "/joint_states.position[2]"),
        ("/joint_states.position[2]", "/joint_states.position[2]"),
        ("/joint_states.position[-1]", "/joint_states.position[-1]"),
        ("/joint_states/position[-3]", "/joint_states.position[-3]"),
        ("/imu/angular_velocity/z", "/imu.angular_velocity.z"),
        ("/imu.angular_velocity.z", "/imu.angular_velocity.z"),
        ("/imu.angular_velocity", "/imu.angular_velocity.z"),
        ("/imu.covariance[-1]", "/imu.covariance[-1]"),
        ("/current", "/current.data"),
        ("/current.data", "/current.data"),
        ("/arm/drive.axes[1].position.raw", "/arm/drive.axes[1].position.raw"),
        ("/arm/drive/axes[1]/position", "/arm/drive.axes[1].position.raw"),
        ("/arm/drive/axes[-1].position.raw", "/arm/drive.axes[-1].position.raw"),
        ("/arm/temperature", "/arm.temperature"),
    ],
)
def test_every_spelling_finds_its_number(source: str, expected: str) -> None:
    assert canonical(resolve(source, LEAVES, TOPICS)) == expected


def test_a_negative_place_is_counted_in_every_message() -> None:
    leaf = resolve("/joint_states.position[-1]", LEAVES, TOPICS)
    assert leaf.steps == ("position", -1)
    assert leaf.joint == ""
    assert leaf.names == ("name",)


@pytest.mark.parametrize(
    "source", ["/joint_states", "/joint_states/position", "/imu", "/arm/drive.axes", "/joint_states/joint_1"]
)
def test_a_path_above_several_numbers_is_ambiguous(source: str) -> None:
    with pytest.raises(InputError, match="ambiguous") as caught:
        resolve(source, LEAVES, TOPICS)
    named = [canonical(leaf) for leaf in LEAVES if canonical(leaf) in caught.value.message]
    assert len(named) >= 2


def test_two_topics_with_the_same_path_are_ambiguous() -> None:
    leaves = [Leaf("/a", ("b", "c")), Leaf("/a/b", ("c",))]
    with pytest.raises(InputError, match="ambiguous") as caught:
        resolve("/a/b/c", leaves)
    assert "/a.b.c" in caught.value.message
    assert "/a/b.c" in caught.value.message
    assert resolve("/a.b.c", leaves) is leaves[0]
    assert resolve("/a/b.c", leaves) is leaves[1]


@pytest.mark.parametrize(
    ("source", "near"),
    [
        ("/joint_states/joint3/position", "/joint_states/joint_3/position"),
        ("/joint_states/position[3]", "/joint_states/position[2]"),
        ("/joint_states/position[-4]", "position["),
        ("/joint_state/joint_3/position", "/joint_states/joint_3/position"),
        ("/Current", "/current.data"),
        ("/arm/drive.axes[2].position.raw", "/arm/drive.axes[1].position.raw"),
    ],
)
def test_a_missing_channel_names_the_nearest(source: str, near: str) -> None:
    with pytest.raises(InputError) as caught:
        resolve(source, LEAVES, TOPICS, log="run.mcap")
    assert repr(source) in caught.value.message
    assert near in caught.value.hint
    assert "flexid inspect run.mcap" in caught.value.hint


def test_the_longest_topic_counts() -> None:
    assert topic_of("/arm/drive/axes[0]", TOPICS) == "/arm/drive"
    assert topic_of("/arm/other", TOPICS) == "/arm"
    assert topic_of("/armature", TOPICS) is None
    assert may_name("imu", "/imu")
    assert not may_name("/imu2.x", "/imu")


def test_a_topic_without_numbers() -> None:
    with pytest.raises(InputError, match="holds no numbers"):
        resolve("/rosout/msg", LEAVES, [*TOPICS, "/rosout"])


def test_nearest_ignores_case() -> None:
    assert nearest("MOTOR_POSITION", ["time", "motor_position"]) == ["motor_position"]


NAMES = st.text("abcde_3", min_size=1, max_size=4)
TOPIC = st.lists(NAMES, min_size=1, max_size=3).map(lambda parts: "/" + "/".join(parts))
STEPS = st.tuples(NAMES, st.lists(st.one_of(NAMES, st.integers(0, 2)), max_size=3)).map(
    lambda t: (t[0], *t[1])
)
PLAIN = st.builds(Leaf, TOPIC, STEPS)
NAMED = st.builds(
    lambda topic, field, place, joint: Leaf(topic, (field, place), joint, ("name",)),
    TOPIC,
    NAMES,
    st.integers(0, 3),
    NAMES,
)


@given(st.lists(st.one_of(PLAIN, NAMED), min_size=1, max_size=12))
def test_canonical_paths_find_themselves_in_any_log(leaves: list[Leaf]) -> None:
    for name in {canonical(leaf) for leaf in leaves}:
        assert canonical(resolve(name, leaves)) == name


@given(st.lists(st.one_of(PLAIN, NAMED), min_size=1, max_size=12), st.data())
def test_another_spelling_finds_the_same_number_or_nothing(leaves: list[Leaf], data: st.DataObject) -> None:
    leaf = data.draw(st.sampled_from(leaves))
    for spelling in spellings(leaf):
        try:
            found = resolve(spelling, leaves)
        except InputError:
            continue
        steps = {(one.topic, one.steps) for one in leaves}
        assert (found.topic, found.steps) in steps
        if len(leaves) == 1:
            assert (found.topic, found.steps) == (leaf.topic, leaf.steps)


@given(st.text(max_size=30), st.lists(st.one_of(PLAIN, NAMED), min_size=1, max_size=6))
def test_any_text_gives_a_leaf_or_an_input_error(source: str, leaves: list[Leaf]) -> None:
    try:
        assert resolve(source, leaves, [leaf.topic for leaf in leaves]).topic
    except InputError as error:
        assert error.hint  # noqa: PT017
