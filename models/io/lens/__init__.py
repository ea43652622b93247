"""One neutral description of a lens, between telescopes and the files of other programs."""
