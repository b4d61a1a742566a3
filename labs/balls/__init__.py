"""Two balls on a table in one camera: closed-form rolling, sliding and impact; soft balls."""

from labs.balls.soft import MOTION, SoftBallModel

__all__ = ["MOTION", "SoftBallModel"]
