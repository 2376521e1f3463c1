"""Views under many lights, for programs that relight pictures (RTI) and for viewers of pictures."""
