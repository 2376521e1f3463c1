"""What the operator writes, read and checked: plan, rig, LED table; and the shots that follow from them."""
