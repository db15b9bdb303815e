"""Laws outside the library: free functions of what is measured, an expression for them, and the effect file made of one."""
