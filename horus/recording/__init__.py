"""Recording, replay and the flight recorder: what happened, kept."""
