"""Resolution: how fine a structure a measurement still shows, and what noise that costs."""
