/* The open camera, and the ports of all modules. Only the remote device, which is the camera itself, has registers
 * and a description of its own; the other modules share one that is empty. */
#include <stdio.h>
#include <string.h>

#include "producer.h"

Module device_module = {"TLDevice", 0}, remote_device = {"Device", 0};
static const char STREAM_ID[] = "frames";
static char open_id[64];
static Identity open_identity;

/* Where the camera's registers say where its description lies: address, then size. */
#define DESCRIPTION_REGISTER 0xa0

static const char EMPTY_DESCRIPTION[] =
    "<?xml version=\"1.0\" encoding=\"utf-8\"?>"
    "<RegisterDescription ModelName=\"Module\" VendorName=\"Coupole\" StandardNameSpace=\"None\""
    " SchemaMajorVersion=\"1\" SchemaMinorVersion=\"1\" SchemaSubMinorVersion=\"0\""
    " MajorVersion=\"1\" MinorVersion=\"0\" SubMinorVersion=\"0\""
    " ProductGuid=\"7d1f54bb-5a39-4d77-8f0f-6a0b6f7b9a01\" VersionGuid=\"7d1f54bb-5a39-4d77-8f0f-6a0b6f7b9a02\""
    " xmlns=\"http://www.genicam.org/GenApi/Version_1_1\">"
    "<Category Name=\"Root\"/>"
    "<Port Name=\"TLPort\"/>"
    "</RegisterDescription>";

const Identity *device_identity(void) { return &open_identity; }

/* -- device ---------------------------------------------------------------------------------------------- */

GC_ERROR describe_device(const char *id, const Identity *identity, INFO_CMD what, Answer answer) {
    int ours = device_module.open && !strcmp(id, open_id);
    switch (what) {
    case DEVICE_INFO_ID: return say_text(answer, id);
    case DEVICE_INFO_VENDOR: return say_text(answer, identity->vendor);
    case DEVICE_INFO_MODEL: case DEVICE_INFO_DISPLAYNAME: return say_text(answer, identity->model);
    case DEVICE_INFO_TLTYPE: return say_text(answer, identity->tl_type);
    case DEVICE_INFO_SERIAL_NUMBER: return say_text(answer, identity->serial);
    case DEVICE_INFO_VERSION: return say_text(answer, identity->version);
    case DEVICE_INFO_USER_DEFINED_NAME: return say_text(answer, "");
    case DEVICE_INFO_TIMESTAMP_FREQUENCY: return say_uint64(answer, identity->ticks_hz);
    case DEVICE_INFO_ACCESS_STATUS:
        return say_int32(answer, ours                      ? DEVICE_ACCESS_STATUS_OPEN_READWRITE
                                 : identity->in_use == '-' ? DEVICE_ACCESS_STATUS_BUSY
                                                           : DEVICE_ACCESS_STATUS_READWRITE);
    default: return fail(GC_ERR_NOT_IMPLEMENTED, "DevGetInfo");
    }
}

GC_ERROR open_device(const char *id, const Identity *identity, DEV_HANDLE *handle) {
    snprintf(open_id, sizeof open_id, "%s", id);
    open_identity = *identity;
    device_module.open = remote_device.open = 1;
    *handle = &device_module;
    return GC_ERR_SUCCESS;
}

GC_ERROR close_device(void) {
    if (stream_module.open) close_stream();
    device_module.open = remote_device.open = 0;
    return let_go();
}

GC_API DevClose(DEV_HANDLE device) {
    NEED(device, device_module);
    return close_device();
}

GC_API DevGetInfo(DEV_HANDLE device, INFO_CMD what, INFO_DATATYPE *type, void *bytes, size_t *size) {
    NEED(device, device_module);
    return describe_device(open_id, &open_identity, what, (Answer){type, bytes, size});
}

GC_API DevGetPort(DEV_HANDLE device, PORT_HANDLE *port) {
    NEED(device, device_module);
    *port = &remote_device;
    return GC_ERR_SUCCESS;
}

GC_API DevGetParentIF(DEV_HANDLE device, IF_HANDLE *interface) {
    NEED(device, device_module);
    *interface = &interface_module;
    return GC_ERR_SUCCESS;
}

GC_API DevGetNumDataStreams(DEV_HANDLE device, uint32_t *count) {
    NEED(device, device_module);
    *count = 1;
    return GC_ERR_SUCCESS;
}

GC_API DevGetDataStreamID(DEV_HANDLE device, uint32_t index, char *id, size_t *size) {
    NEED(device, device_module);
    if (index) return fail(GC_ERR_INVALID_INDEX, "there is one data stream");
    return say_text((Answer){NULL, id, size}, STREAM_ID);
}

GC_API DevOpenDataStream(DEV_HANDLE device, const char *id, DS_HANDLE *handle) {
    NEED(device, device_module);
    if (strcmp(id, STREAM_ID)) return fail(GC_ERR_INVALID_ID, "no such data stream");
    if (stream_module.open) return fail(GC_ERR_RESOURCE_IN_USE, "the data stream is open already");
    stream_module.open = 1;
    *handle = &stream_module;
    return GC_ERR_SUCCESS;
}

/* -- ports ----------------------------------------------------------------------------------------------- */

#define NEED_PORT(port) \
    if (!(port) || !(port)->open) return fail(GC_ERR_INVALID_HANDLE, "no open port")

GC_API GCReadPort(PORT_HANDLE port, uint64_t address, void *data, size_t *size) {
    NEED_PORT(port);
    if (port == &remote_device) return read_registers(address, data, *size);
    if (address > sizeof EMPTY_DESCRIPTION - 1 || *size > sizeof EMPTY_DESCRIPTION - 1 - address)
        return fail(GC_ERR_INVALID_ADDRESS, "the module has no such register");
    memcpy(data, EMPTY_DESCRIPTION + address, *size);
    return GC_ERR_SUCCESS;
}

GC_API GCWritePort(PORT_HANDLE port, uint64_t address, const void *data, size_t *size) {
    NEED_PORT(port);
    if (port == &remote_device) return write_registers(address, data, *size);
    return fail(GC_ERR_ACCESS_DENIED, "the module's registers cannot be written");
}

GC_API GCReadPortStacked(PORT_HANDLE port, PORT_REGISTER_STACK_ENTRY *entries, size_t *count) {
    for (size_t k = 0, wanted = *count; k < wanted; k++) {
        *count = k;
        GC_ERROR code = GCReadPort(port, entries[k].address, entries[k].data, &(size_t){entries[k].size});
        if (code) return code;
        *count = k + 1;
    }
    return GC_ERR_SUCCESS;
}

GC_API GCWritePortStacked(PORT_HANDLE port, PORT_REGISTER_STACK_ENTRY *entries, size_t *count) {
    for (size_t k = 0, wanted = *count; k < wanted; k++) {
        *count = k;
        GC_ERROR code = GCWritePort(port, entries[k].address, entries[k].data, &(size_t){entries[k].size});
        if (code) return code;
        *count = k + 1;
    }
    return GC_ERR_SUCCESS;
}

GC_API GCGetPortInfo(PORT_HANDLE port, INFO_CMD what, INFO_DATATYPE *type, void *bytes, size_t *size) {
    NEED_PORT(port);
    Answer answer = {type, bytes, size};
    int remote = port == &remote_device;
    switch (what) {
    case PORT_INFO_ID: return say_text(answer, remote ? open_id : port->kind);
    case PORT_INFO_VENDOR: return say_text(answer, remote ? open_identity.vendor : "Coupole");
    case PORT_INFO_MODEL: return say_text(answer, remote ? open_identity.model : "Stand-in for a GenTL producer");
    case PORT_INFO_TLTYPE: return say_text(answer, remote ? open_identity.tl_type : "Custom");
    case PORT_INFO_MODULE: return say_text(answer, port->kind);
    case PORT_INFO_VERSION: return say_text(answer, remote ? open_identity.version : "1.0");
    case PORT_INFO_PORTNAME: return say_text(answer, remote ? "Device" : "TLPort");
    case PORT_INFO_LITTLE_ENDIAN: case PORT_INFO_ACCESS_READ: return say_bool(answer, 1);
    case PORT_INFO_ACCESS_WRITE: return say_bool(answer, remote);
    case PORT_INFO_BIG_ENDIAN: case PORT_INFO_ACCESS_NA: case PORT_INFO_ACCESS_NI: return say_bool(answer, 0);
    default: return fail(GC_ERR_NOT_IMPLEMENTED, "GCGetPortInfo");
    }
}

static GC_ERROR find_description(PORT_HANDLE port, uint64_t place[2]) {
    if (port == &remote_device) return read_registers(DESCRIPTION_REGISTER, place, 2 * sizeof *place);
    place[0] = 0;
    place[1] = sizeof EMPTY_DESCRIPTION - 1;
    return GC_ERR_SUCCESS;
}

GC_API GCGetNumPortURLs(PORT_HANDLE port, uint32_t *count) {
    NEED_PORT(port);
    *count = 1;
    return GC_ERR_SUCCESS;
}

GC_API GCGetPortURLInfo(PORT_HANDLE port, uint32_t index, INFO_CMD what, INFO_DATATYPE *type, void *bytes,
                        size_t *size) {
    NEED_PORT(port);
    if (index) return fail(GC_ERR_INVALID_INDEX, "there is one description");
    uint64_t place[2];
    char url[100];
    GC_ERROR code = find_description(port, place);
    if (code) return code;
    Answer answer = {type, bytes, size};
    snprintf(url, sizeof url, "local:%s.xml;%llx;%llx", port->kind, (unsigned long long)place[0],
             (unsigned long long)place[1]);
    switch (what) {
    case URL_INFO_URL: return say_text(answer, url);
    case URL_INFO_FILE_REGISTER_ADDRESS: return say_uint64(answer, place[0]);
    case URL_INFO_FILE_SIZE: return say_uint64(answer, place[1]);
    case URL_INFO_SCHEME: return say_int32(answer, URL_SCHEME_LOCAL);
    default: return fail(GC_ERR_NOT_IMPLEMENTED, "GCGetPortURLInfo");
    }
}

GC_API GCGetPortURL(PORT_HANDLE port, char *url, size_t *size) {
    return GCGetPortURLInfo(port, 0, URL_INFO_URL, NULL, url, size);
}
