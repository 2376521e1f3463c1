/* The library itself, and its system and interface: cameras are the sockets `*.camera` beside this file. */
#define _GNU_SOURCE
#include <dirent.h>
#include <dlfcn.h>
#include <stdio.h>
#include <string.h>

#include "producer.h"

#define MOST_CAMERAS 8

Module system_module = {"TLSystem", 0}, interface_module = {"TLInterface", 0};
static int initialised;
static _Thread_local GC_ERROR last_code;
static _Thread_local char last_text[256];
static struct {
    char id[64], path[512];
    Identity identity;
} cameras[MOST_CAMERAS];
static uint32_t camera_count;

/* -- answers --------------------------------------------------------------------------------------------- */

GC_ERROR fail(GC_ERROR code, const char *why) {
    last_code = code;
    snprintf(last_text, sizeof last_text, "%s", why);
    return code;
}

GC_ERROR say(Answer answer, INFO_DATATYPE type, const void *value, size_t size) {
    if (!answer.size) return fail(GC_ERR_INVALID_PARAMETER, "no size given");
    if (answer.type) *answer.type = type;
    size_t room = *answer.size;
    *answer.size = size;
    if (!answer.bytes) return GC_ERR_SUCCESS;
    if (room < size) return fail(GC_ERR_BUFFER_TOO_SMALL, "the answer does not fit");
    memcpy(answer.bytes, value, size);
    return GC_ERR_SUCCESS;
}

GC_ERROR say_text(Answer answer, const char *text) {
    return say(answer, INFO_DATATYPE_STRING, text, strlen(text) + 1);
}
GC_ERROR say_bool(Answer answer, int value) { return say(answer, INFO_DATATYPE_BOOL8, &(bool8_t){value != 0}, 1); }
GC_ERROR say_int32(Answer answer, int32_t value) { return say(answer, INFO_DATATYPE_INT32, &value, 4); }
GC_ERROR say_uint32(Answer answer, uint32_t value) { return say(answer, INFO_DATATYPE_UINT32, &value, 4); }
GC_ERROR say_uint64(Answer answer, uint64_t value) { return say(answer, INFO_DATATYPE_UINT64, &value, 8); }
GC_ERROR say_size(Answer answer, size_t value) { return say(answer, INFO_DATATYPE_SIZET, &value, sizeof value); }
GC_ERROR say_pointer(Answer answer, void *value) { return say(answer, INFO_DATATYPE_PTR, &value, sizeof value); }

/* -- library --------------------------------------------------------------------------------------------- */

GC_API GCInitLib(void) {
    if (initialised) return fail(GC_ERR_RESOURCE_IN_USE, "this process has initialised the library already");
    initialised = 1;
    return GC_ERR_SUCCESS;
}

GC_API TLClose(TL_HANDLE system);
GC_API GCCloseLib(void) {
    if (!initialised) return fail(GC_ERR_NOT_INITIALIZED, "the library is not initialised");
    if (system_module.open) TLClose(&system_module);
    initialised = 0;
    return GC_ERR_SUCCESS;
}

GC_API GCGetLastError(GC_ERROR *code, char *text, size_t *size) {
    if (code) *code = last_code;
    return say((Answer){NULL, text, size}, INFO_DATATYPE_STRING, last_text, strlen(last_text) + 1);
}

static const char *own_path(void) {
    Dl_info info;
    return dladdr((void *)own_path, &info) ? info.dli_fname : "";
}

static GC_ERROR describe_system(INFO_CMD what, Answer answer) {
    const char *path = own_path(), *slash = strrchr(path, '/');
    switch (what) {
    case TL_INFO_ID: case TL_INFO_PATHNAME: return say_text(answer, path);
    case TL_INFO_NAME: return say_text(answer, slash ? slash + 1 : path);
    case TL_INFO_VENDOR: return say_text(answer, "Coupole");
    case TL_INFO_MODEL: case TL_INFO_DISPLAYNAME: return say_text(answer, "Stand-in for a GenTL producer");
    case TL_INFO_VERSION: return say_text(answer, "1.0");
    case TL_INFO_TLTYPE: return say_text(answer, "Mixed");
    case TL_INFO_CHAR_ENCODING: return say_int32(answer, 1);
    case TL_INFO_GENTL_VER_MAJOR: return say_uint32(answer, 1);
    case TL_INFO_GENTL_VER_MINOR: return say_uint32(answer, 5);
    default: return fail(GC_ERR_NOT_IMPLEMENTED, "TLGetInfo");
    }
}

GC_API GCGetInfo(INFO_CMD what, INFO_DATATYPE *type, void *bytes, size_t *size) {
    if (!initialised) return fail(GC_ERR_NOT_INITIALIZED, "the library is not initialised");
    return describe_system(what, (Answer){type, bytes, size});
}

/* -- system ---------------------------------------------------------------------------------------------- */

static const char INTERFACE_ID[] = "sockets";

GC_API TLOpen(TL_HANDLE *handle) {
    if (!initialised) return fail(GC_ERR_NOT_INITIALIZED, "the library is not initialised");
    if (system_module.open) return fail(GC_ERR_RESOURCE_IN_USE, "the system is open already");
    system_module.open = 1;
    *handle = &system_module;
    return GC_ERR_SUCCESS;
}

GC_API IFClose(IF_HANDLE interface);
GC_API TLClose(TL_HANDLE system) {
    NEED(system, system_module);
    if (interface_module.open) IFClose(&interface_module);
    system_module.open = 0;
    return GC_ERR_SUCCESS;
}

GC_API TLGetInfo(TL_HANDLE system, INFO_CMD what, INFO_DATATYPE *type, void *bytes, size_t *size) {
    NEED(system, system_module);
    return describe_system(what, (Answer){type, bytes, size});
}

GC_API TLUpdateInterfaceList(TL_HANDLE system, bool8_t *changed, uint64_t timeout_ms) {
    (void)timeout_ms;
    NEED(system, system_module);
    if (changed) *changed = 0;
    return GC_ERR_SUCCESS;
}

GC_API TLGetNumInterfaces(TL_HANDLE system, uint32_t *count) {
    NEED(system, system_module);
    *count = 1;
    return GC_ERR_SUCCESS;
}

GC_API TLGetInterfaceID(TL_HANDLE system, uint32_t index, char *id, size_t *size) {
    NEED(system, system_module);
    if (index) return fail(GC_ERR_INVALID_INDEX, "there is one interface");
    return say_text((Answer){NULL, id, size}, INTERFACE_ID);
}

static GC_ERROR describe_interface(INFO_CMD what, Answer answer) {
    switch (what) {
    case INTERFACE_INFO_ID: case INTERFACE_INFO_DISPLAYNAME: return say_text(answer, INTERFACE_ID);
    case INTERFACE_INFO_TLTYPE: return say_text(answer, "Custom");
    default: return fail(GC_ERR_NOT_IMPLEMENTED, "IFGetInfo");
    }
}

GC_API TLGetInterfaceInfo(TL_HANDLE system, const char *id, INFO_CMD what, INFO_DATATYPE *type, void *bytes,
                          size_t *size) {
    NEED(system, system_module);
    if (strcmp(id, INTERFACE_ID)) return fail(GC_ERR_INVALID_ID, "no such interface");
    return describe_interface(what, (Answer){type, bytes, size});
}

GC_API TLOpenInterface(TL_HANDLE system, const char *id, IF_HANDLE *handle) {
    NEED(system, system_module);
    if (strcmp(id, INTERFACE_ID)) return fail(GC_ERR_INVALID_ID, "no such interface");
    if (interface_module.open) return fail(GC_ERR_RESOURCE_IN_USE, "the interface is open already");
    interface_module.open = 1;
    *handle = &interface_module;
    return GC_ERR_SUCCESS;
}

/* -- interface ------------------------------------------------------------------------------------------- */

GC_API IFClose(IF_HANDLE interface) {
    NEED(interface, interface_module);
    if (device_module.open) close_device();
    interface_module.open = 0;
    camera_count = 0;
    return GC_ERR_SUCCESS;
}

GC_API IFGetInfo(IF_HANDLE interface, INFO_CMD what, INFO_DATATYPE *type, void *bytes, size_t *size) {
    NEED(interface, interface_module);
    return describe_interface(what, (Answer){type, bytes, size});
}

GC_API IFGetParentTL(IF_HANDLE interface, TL_HANDLE *system) {
    NEED(interface, interface_module);
    *system = &system_module;
    return GC_ERR_SUCCESS;
}

GC_API IFUpdateDeviceList(IF_HANDLE interface, bool8_t *changed, uint64_t timeout_ms) {
    (void)timeout_ms;
    NEED(interface, interface_module);
    char folder[400];
    snprintf(folder, sizeof folder, "%s", own_path());
    char *slash = strrchr(folder, '/');
    if (slash) *slash = 0;
    DIR *directory = opendir(slash ? folder : ".");
    if (!directory) return fail(GC_ERR_IO, "cannot read the producer's folder");
    camera_count = 0;
    for (struct dirent *entry; (entry = readdir(directory)) && camera_count < MOST_CAMERAS;) {
        size_t length = strlen(entry->d_name);
        if (length < 8 || length >= sizeof cameras->id || strcmp(entry->d_name + length - 7, ".camera")) continue;
        snprintf(cameras[camera_count].id, sizeof cameras->id, "%.63s", entry->d_name);
        snprintf(cameras[camera_count].path, sizeof cameras->path, "%s/%.63s", folder, entry->d_name);
        if (!look_at(cameras[camera_count].path, &cameras[camera_count].identity)) camera_count++;
    }
    closedir(directory);
    if (changed) *changed = 1;
    return GC_ERR_SUCCESS;
}

GC_API IFGetNumDevices(IF_HANDLE interface, uint32_t *count) {
    NEED(interface, interface_module);
    *count = camera_count;
    return GC_ERR_SUCCESS;
}

GC_API IFGetDeviceID(IF_HANDLE interface, uint32_t index, char *id, size_t *size) {
    NEED(interface, interface_module);
    if (index >= camera_count) return fail(GC_ERR_INVALID_INDEX, "no such camera");
    return say_text((Answer){NULL, id, size}, cameras[index].id);
}

static int find(const char *id) {
    for (uint32_t k = 0; k < camera_count; k++)
        if (!strcmp(cameras[k].id, id)) return (int)k;
    return -1;
}

GC_API IFGetDeviceInfo(IF_HANDLE interface, const char *id, INFO_CMD what, INFO_DATATYPE *type, void *bytes,
                       size_t *size) {
    NEED(interface, interface_module);
    int found = find(id);
    if (found < 0) return fail(GC_ERR_INVALID_ID, "no such camera");
    return describe_device(id, &cameras[found].identity, what, (Answer){type, bytes, size});
}

GC_API IFOpenDevice(IF_HANDLE interface, const char *id, ACCESS_FLAGS access, DEV_HANDLE *handle) {
    (void)access;
    NEED(interface, interface_module);
    int found = find(id);
    if (found < 0) return fail(GC_ERR_INVALID_ID, "no such camera");
    if (device_module.open) return fail(GC_ERR_RESOURCE_IN_USE, "a camera is open already");
    GC_ERROR code = take_hold(cameras[found].path);
    return code ? code : open_device(id, &cameras[found].identity, handle);
}
