"""One survey assembled, watched and concluded."""
