"""The console's screens, made with NiceGUI: each module builds one; `all_screens` lists them."""
