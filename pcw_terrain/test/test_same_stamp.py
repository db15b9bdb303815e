"""Messages of two streams that belong together."""

from pcw_terrain.nodes.same_stamp import KEPT, SameStamp


def test_whichever_comes_first_they_are_paired_once():
    pairs = SameStamp()
    assert pairs.first(1, "a") is None and pairs.second(1, "A") == ("a", "A")
    assert pairs.second(2, "B") is None and pairs.first(2, "b") == ("b", "B")
    assert pairs.second(2, "B") is None and pairs.first(2, "b") is None


def test_those_without_a_partner_are_left_out_and_order_is_kept():
    pairs = SameStamp()
    for stamp in range(1, 6):
        assert pairs.first(stamp, stamp) is None
    assert pairs.second(3, "C") == (3, "C")
    assert pairs.second(2, "late") is None and pairs.second(5, "E") == (5, "E")


def test_it_does_not_keep_everything():
    pairs = SameStamp()
    for stamp in range(3 * KEPT):
        pairs.first(stamp, stamp)
    assert pairs.second(1, "too old") is None and pairs.second(3 * KEPT - 1, "new") == (3 * KEPT - 1, "new")
