"""Floor 1: what training any method shares: networks, Adam, a run's folder and files, what a run predicts."""
