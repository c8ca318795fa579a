"""Job kinds that follow a surface from state to state: displacement, strain, and what is made of them."""
