/** Base64 images as URLs of blobs, which browsers decode once, wherever they stand. */

const urls = new Map<string, string>();

export function toBlobUrl(webp: string): string {
  let url = urls.get(webp);
  if (!url) {
    const bytes = Uint8Array.from(atob(webp), (sign) => sign.charCodeAt(0));
    url = URL.createObjectURL(new Blob([bytes], { type: "image/webp" }));
    urls.set(webp, url);
  }
  return url;
}
