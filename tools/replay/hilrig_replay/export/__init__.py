"""Export of recordings to other formats, and playback on the bus."""
