"""What comes in over zenoh: decoded and refused on zenoh's threads, done on the loop's."""
