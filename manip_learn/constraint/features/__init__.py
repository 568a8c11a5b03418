"""Feature maps Phi(q): matrices whose rows a constraint A(q) = Lambda Phi(q) selects and combines."""
