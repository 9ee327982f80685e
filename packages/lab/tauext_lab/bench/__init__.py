"""An open benchmark of sensorless collision detection: tracks of recordings, and any method on them."""
