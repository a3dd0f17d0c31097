"""Recording a rig: cameras, shots, guidance for the person at the board, and the order of it all."""
