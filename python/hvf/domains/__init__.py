"""Places to plan in: what every command asks of one."""
