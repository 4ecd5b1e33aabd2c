from sarsplat.rivals.config import RivalConfig

DSR = RivalConfig()
