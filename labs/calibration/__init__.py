"""What thresholds of a diagnosis do: each halved and doubled, answers made again and counted."""
