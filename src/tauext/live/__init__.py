"""The monitor on a live arm: sources of samples, the loop, what follows from its verdicts."""

from tauext.live.latency import Latencies
from tauext.live.leader_feedback import FeedbackSettings, LeaderFeedback, free_motion_sigmas
from tauext.live.loop import Loop, LoopSettings, ProfileSwitch
from tauext.live.profiles import Profile, Profiles, load_profiles
from tauext.live.reaction_file import Reaction, load_reactions
from tauext.live.reactions import ReactionCount, ReactionNews, Reactions, ReactionThread, start_reactions
from tauext.live.real_time import ask_for_real_time
from tauext.live.replay_source import ReplaySource
from tauext.live.sample_queue import SampleQueue
from tauext.live.sink import EVENT_KINDS, Control, Event, EventKind, LoopReport, Publisher, Sink, Verdict
from tauext.live.source import Sample, Source, SourceCounts, SourceSettings, Stoppable

__all__ = [
    "EVENT_KINDS",
    "Control",
    "Event",
    "EventKind",
    "FeedbackSettings",
    "Latencies",
    "LeaderFeedback",
    "Loop",
    "LoopReport",
    "LoopSettings",
    "Profile",
    "ProfileSwitch",
    "Profiles",
    "Publisher",
    "Reaction",
    "ReactionCount",
    "ReactionNews",
    "ReactionThread",
    "Reactions",
    "ReplaySource",
    "Sample",
    "SampleQueue",
    "Sink",
    "Source",
    "SourceCounts",
    "SourceSettings",
    "Stoppable",
    "Verdict",
    "ask_for_real_time",
    "free_motion_sigmas",
    "load_profiles",
    "load_reactions",
    "start_reactions",
]
