"""The contract: one test, or a few, per promise, named and worded after it."""
