"""Pictures without poses as datasets: frames, what to cut out, structure from motion."""
