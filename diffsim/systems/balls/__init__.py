"""Two balls on a table in one camera: closed-form rolling, sliding and impact; soft balls."""

from diffsim.systems.balls.soft import MOTION, SoftBallModel
from diffsim.systems.rigid_body.ball_effects import (
    BALL_FRICTION,
    ROLLING_RESISTANCE,
    SLIDING_FRICTION,
)

__all__ = ["BALL_FRICTION", "MOTION", "ROLLING_RESISTANCE", "SLIDING_FRICTION", "SoftBallModel"]
