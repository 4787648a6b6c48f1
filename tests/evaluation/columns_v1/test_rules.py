"""Rules and their letters."""

from mapvote_lab.evaluation.columns_v1.rules import ALL_RULES, Rules, by_letters


def test_rules_are_named_by_the_letters_of_the_manual() -> None:
    assert by_letters("ABCDEFGHI") == ALL_RULES
    assert by_letters("ABCDEFG") == Rules(roofs_fall=False, remnants_go=False)
    assert by_letters("BCDEFGHI") == Rules(empty_by_ray=False)
