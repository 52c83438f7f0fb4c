"""What goes over the wire, a file a door: message types, and the decoding of what comes in."""
