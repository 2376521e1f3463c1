/* What the files of this producer share. There is one system with one interface, and one camera can be open at a
 * time; so each module is a single object, and its handle the object's address. */
#ifndef PRODUCER_H
#define PRODUCER_H

#include "gentl.h"

#define TEXT_BYTES 32

struct Module {
    const char *kind; /* as PORT_INFO_MODULE has it */
    int open;
};
extern Module system_module, interface_module, device_module, remote_device, stream_module;

/* What a camera says of itself to whoever asks, as it comes over the cable. */
typedef struct {
    uint64_t ticks_hz; /* of its timestamps; 1e9 for nanoseconds */
    char in_use;       /* '-' while a client has the camera, else '+' */
    char tl_type[TEXT_BYTES], vendor[TEXT_BYTES], model[TEXT_BYTES], serial[TEXT_BYTES], version[TEXT_BYTES];
} Identity;

/* -- answers (library.c) --------------------------------------------------------------------------------- */

/* Where a question's answer goes: type, bytes and their number, each as GenTL's ...GetInfo functions have it. */
typedef struct {
    INFO_DATATYPE *type;
    void *bytes;
    size_t *size;
} Answer;

GC_ERROR fail(GC_ERROR code, const char *why);
GC_ERROR say(Answer answer, INFO_DATATYPE type, const void *value, size_t size);
GC_ERROR say_text(Answer answer, const char *text);
GC_ERROR say_bool(Answer answer, int value);
GC_ERROR say_int32(Answer answer, int32_t value);
GC_ERROR say_uint32(Answer answer, uint32_t value);
GC_ERROR say_uint64(Answer answer, uint64_t value);
GC_ERROR say_size(Answer answer, size_t value);
GC_ERROR say_pointer(Answer answer, void *value);

/* Ends the calling function unless the module is open. */
#define NEED(handle, module) \
    if ((handle) != &(module) || !(module).open) return fail(GC_ERR_INVALID_HANDLE, "no open " #module)

/* -- the cable (cable.c) --------------------------------------------------------------------------------- */

GC_ERROR look_at(const char *camera, Identity *identity);
GC_ERROR take_hold(const char *camera);
GC_ERROR let_go(void);
GC_ERROR connect_frames(int *cable);
GC_ERROR read_registers(uint64_t address, void *data, size_t size);
GC_ERROR write_registers(uint64_t address, const void *data, size_t size);

/* -- modules --------------------------------------------------------------------------------------------- */

const Identity *device_identity(void); /* of the open camera */
GC_ERROR describe_device(const char *id, const Identity *identity, INFO_CMD what, Answer answer);
GC_ERROR open_device(const char *id, const Identity *identity, DEV_HANDLE *handle);
GC_ERROR close_stream(void);
GC_ERROR close_device(void);
void cancel_event(void);

#endif
