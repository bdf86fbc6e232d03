"""The run loop: releases, wake-ups, supervision and shutdown of one run."""
