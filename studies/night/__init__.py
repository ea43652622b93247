"""Nights of visit lists: PSFs of each visit and detector, tables of them, and maps of the sky."""
