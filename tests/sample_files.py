from made import *  # noqa: F403
