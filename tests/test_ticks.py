"""When a bus is asked, by a clock of the test's."""

from tauext.sources.reader import Ticks


def test_ticks_keep_their_times_and_skip_those_that_passed():
    now, slept = [100.0], []

    def sleep(seconds):
        slept.append(seconds)
        now[0] += seconds

    ticks = Ticks(0.25, lambda: now[0], sleep)
    assert ticks.wait(1.0) == 0 and slept == []  # the first at once
    now[0] += 0.125  # an answer came
    assert ticks.wait(1.0) == 0 and now[0] == 100.25
    now[0] += 0.375  # 100.625: the tick of 100.5 is late and not skipped
    assert ticks.wait(1.0) == 0 and now[0] == 100.625
    assert ticks.wait(1.0) == 0 and now[0] == 100.75
    now[0] += 0.8125  # 101.5625: of 101.0, 101.25, 101.5 the last is still to be used
    assert ticks.wait(1.0) == 2 and now[0] == 101.5625
    assert ticks.wait(1.0) == 0 and now[0] == 101.75
    assert ticks.wait(0.125) is None and now[0] == 101.875
    assert ticks.wait(0.125) == 0 and now[0] == 102.0
