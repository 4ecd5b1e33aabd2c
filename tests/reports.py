from made_runs import *  # noqa: F403
