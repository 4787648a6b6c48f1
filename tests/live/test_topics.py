"""What a vehicle lacks among the topics of a network."""

from __future__ import annotations

from mapvote.live.dds import SentTopic
from mapvote.live.topics import CLOUD, ODOMETRY, TF, Listened, missing_for_drive


def heard(topic: str, kind: str, messages: int = 9) -> Listened:
    return Listened(SentTopic(topic, kind, 1, True, kind == TF), messages, messages / 5.0, "")


VEHICLE = [heard("/points", CLOUD), heard("/odom", ODOMETRY), heard("/tf_static", TF, 1)]


def test_a_vehicle_that_sends_clouds_odometry_and_its_frames_lacks_nothing() -> None:
    assert missing_for_drive(VEHICLE) == []


def test_each_topic_that_is_absent_has_a_sentence_of_its_own() -> None:
    for absent, said in enumerate((CLOUD, ODOMETRY, "/tf_static")):
        (sentence,) = missing_for_drive([one for k, one in enumerate(VEHICLE) if k != absent])
        assert said in sentence


def test_a_topic_that_is_offered_but_sends_nothing_is_missing() -> None:
    (sentence,) = missing_for_drive([heard("/points", CLOUD, 0), *VEHICLE[1:]])
    assert CLOUD in sentence


def test_transforms_on_another_topic_are_no_tf_static() -> None:
    (sentence,) = missing_for_drive([*VEHICLE[:2], heard("/tf", TF)])
    assert "/tf_static" in sentence


def test_on_a_silent_network_the_domain_and_the_interface_are_named() -> None:
    (sentence,) = missing_for_drive([])
    assert "ROS_DOMAIN_ID" in sentence
    assert "CYCLONEDDS_URI" in sentence
