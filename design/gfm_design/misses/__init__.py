"""What a loop bears of ticks without a new u: words, bounds for all of them, statistics."""
