"""Where nodes run: one executor per execution class."""
