"""The thesis's tables and figures beside ours: data, trainings, evaluations, one page."""
