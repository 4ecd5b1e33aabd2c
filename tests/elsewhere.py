from programs import *  # noqa: F403
