"""Controllers for studies: built in, LQR and the user's own."""
