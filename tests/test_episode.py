"""Episodes of alarms in a loop, against the torques and limits themselves."""

import numpy as np
import pytest
from made_bundles import pushed, watching_bundle
from made_live import Keeper, ScriptedSource, samples_of

from tauext.bundle.estimates import COLLISION, CONTACT
from tauext.monitor.episode import LASTS_NS
from tauext.monitor.loop import Loop, LoopSettings


@pytest.fixture(scope="module")
def bundle():
    return watching_bundle()


def told(bundle, **push):
    """The verdicts of a loop, and of each alarm all that was told of it."""
    keeper = Keeper()
    samples = samples_of(pushed(**push))
    Loop(bundle, ScriptedSource(samples), [keeper], settings=LoopSettings(missing_after_s=60.0)).run()
    news: dict[int, list] = {}
    for verdict in keeper.verdicts:
        for one in verdict.news:
            news.setdefault(one.number, []).append((verdict.t_ns, one))
    return keeper.verdicts, news


def over_ns(verdicts):
    """Stamps at which a torque is over a limit."""
    over = []
    for verdict in verdicts:
        values = verdict.estimates
        size = np.abs(values["tau_ext"] - values["load_nm"])
        over += [verdict.t_ns] * bool((size > np.minimum(values["limit_nm"], values["contact_limit_nm"])).any())
    return np.array(over)


def test_an_episode_lasts_from_its_rise_to_the_last_sample_over_a_limit(bundle):
    verdicts, news = told(bundle, seconds=5, pushes=((2.0, 0, 1.5), (3.5, 0, 12.0)), length_s=0.4)
    over, release_ns = over_ns(verdicts), round(bundle.contact_release_s * 1e9)
    assert list(news) == [1, 2]
    for number, stories in news.items():
        ends = [one for _, one in stories if not one.is_touched]
        touched = over[(over >= stories[0][1].t_ns) & (over < stories[0][1].t_ns + 10**9)]
        assert ends and ends[-1].touch_t_ns == touched[-1] and ends[-1].number == number
        at_ns = next(t_ns for t_ns, one in stories if not one.is_touched)
        assert at_ns == touched[-1] + release_ns  # neither before nor long after it
    contact, collision = (stories[-1][1] for stories in news.values())
    assert (contact.alarm, contact.ended) == (CONTACT, True) and (collision.alarm, collision.ended) == (
        COLLISION,
        False,
    )
    levels = [one.alarm for _, one in news[2]]
    assert levels[0] == CONTACT and COLLISION in levels  # one episode at both levels
    share = np.array([1 - v.estimates["margin_nm"][0] / v.estimates["limit_nm"][0] for v in verdicts])
    held = np.array([v.estimates["held_alarm"][0] > 0 and v.t_ns >= collision.t_ns for v in verdicts])
    assert collision.over == pytest.approx(share[held].max(axis=0))


@pytest.mark.slow
def test_a_touch_that_lasts_is_reported_again_before_its_end(bundle):
    _, news = told(bundle, seconds=10, pushes=((2.0, 0, 1.5),), length_s=6.5)
    stories = news[1]
    lasting = [(t_ns, one) for t_ns, one in stories if one.is_touched and one.touch_t_ns > one.t_ns + LASTS_NS]
    assert lasting and lasting[0][0] == lasting[0][1].touch_t_ns
